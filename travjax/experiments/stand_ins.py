"""Built-in sites that replace real maps where there are none: rock fields, split and read like real sites."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from travjax.config import InputError, require
from travjax.data.provenance import SitesConfig
from travjax.experiments.transfer_runs import TransferConfig
from travjax.files import find_data, output_folder, put_back, save_npz
from travjax.runs.run import DATA
from travjax.terrain.rock_field import SITES, site_heights

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DESCRIPTION = "stand_in.toml"
"""Name of the file beside that of the real sites that lists the stand-in sites and their splits."""

FOLDER = "stand_ins"
"""Name of the folder, within that of an experiment, that holds the rasters."""

SPACING = 0.0625
"""Metres between the nodes of the rasters."""


@dataclass(frozen=True)
class StandIns:
    """The stand-in sites of an experiment.

    sites:  configuration of the data set, with stride, gap and so on of the real sites
    folder: folder of the rasters
    """

    sites: SitesConfig
    folder: Path

    @staticmethod
    def load(real: Path, out: Path) -> "StandIns":
        """Returns the sites that stand in for those of the file `real`, for an experiment in the folder `out`.

        Raises InputError when that file or the one of the stand-ins beside it is missing or wrong.
        """
        config, path, folder = SitesConfig.load(real), real.parent / DESCRIPTION, out / FOLDER
        sites = SitesConfig.load(path).site
        for site in sites:
            require(Path(site.file).stem in SITES, f"{path}: file", site.file, f"{', '.join(SITES)}, and .npz")
        placed = tuple(replace(site, file=str(folder / site.file)) for site in sites)
        return StandIns(replace(config, site=placed), folder)

    def in_place_of_real(self, config: TransferConfig) -> TransferConfig:
        """Returns the experiment with these sites in place of the real ones; its figure shows maps of the last site."""
        sites = Path(config.sites).with_name(DESCRIPTION)
        return replace(config, sites=str(sites), shown=self.sites.site[-1].group)

    @property
    def sentence(self) -> str:
        """One sentence that tells readers of results what the sites are."""
        names = " and ".join(Path(site.file).stem for site in self.sites.site)
        return (
            f"Built-in stand-in sites take the place of real maps: {names}, made by travjax (docs/stand-in-sites.md). "
            "Scores on them are no evidence about real ground."
        )

    def write(self) -> None:
        """Writes the rasters."""
        output_folder(self.folder)
        for site in self.sites.site:
            save_npz(Path(site.file), heights=site_heights(Path(site.file).stem, SPACING), cell_size=SPACING)

    def figure(self) -> "Figure":
        """Draws the sites in one colour scale, shaded from the north-west, with the strips of their splits."""
        from matplotlib.colors import LightSource  # matplotlib takes 0.3 s to import
        from matplotlib.figure import Figure

        maps = [site_heights(Path(site.file).stem, SPACING) for site in self.sites.site]
        widths, tall = [one.shape[1] for one in maps], max(one.shape[0] for one in maps)
        figure = Figure(figsize=(11, 11 * 0.9 * tall / sum(widths) + 0.9), layout="constrained")
        axes = figure.subplots(1, len(maps), squeeze=False, sharey=True, width_ratios=widths)[0]
        low, high = np.percentile(np.concatenate([one.ravel() for one in maps]), [0.5, 99.5])
        for ax, site, heights in zip(axes, self.sites.site, maps, strict=True):
            north, east = ((edge - 1) * SPACING for edge in heights.shape)
            extent = (0.0, east, 0.0, north)
            image = ax.imshow(heights, origin="lower", extent=extent, cmap="cividis", vmin=low, vmax=high)
            shade = LightSource(315, 35).hillshade(heights[::-1], dx=SPACING, dy=SPACING)[::-1]
            ax.imshow(shade, origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1, alpha=0.6)
            for split, strip in site.strips.items():
                if strip:
                    _draw_strip(ax, split, *strip, east, north)
            ax.set(title=f"{site.group}: {site.split}", xlabel="x, east [m]")
        axes[0].set_ylabel("y, north [m]")
        figure.colorbar(image, ax=axes.tolist(), label="elevation [m]", shrink=0.8)
        return figure


def _draw_strip(ax: "Axes", split: str, side: str, metres: float, east: float, north: float) -> None:
    """Marks and labels the strip of a split on a site of `east` x `north` metres."""
    along_x, first = side in ("east", "west"), side in ("south", "west")
    length, across = (east, north) if along_x else (north, east)
    middle, inner = (metres / 2, metres) if first else (length - metres / 2, length - metres)
    draw = ax.axvline if along_x else ax.axhline
    draw(inner, color="white", linewidth=2.5)
    draw(inner, color="black", linewidth=1.2, linestyle="--")
    place = (middle, across * 0.97) if along_x else (across / 2, middle)
    ax.text(*place, split, ha="center", va="top", fontsize=9, bbox=dict(facecolor="white", edgecolor="none", pad=2))


def chosen_stand_ins(real: Path, out: Path, asked: bool, data: Path | None) -> StandIns | None:
    """Returns the stand-in sites if asked for, or if neither a data set nor any file of the real sites exists.

    real: TOML file of the real sites; out: folder of the experiment; data: data set that is given
    Raises InputError where a data set is given as well, and where real maps would continue a run on stand-ins.
    """
    put_back(out / DATA)
    begun = (out / FOLDER).exists()
    if asked:
        require(data is None, "--data", str(data), "left out where --stand-ins is given")
    elif data is None and (begun or not (out / DATA / "dataset.json").exists()):
        asked = _none_is_there(real)
    if begun and not asked:
        allowed = "another folder, or --stand-ins to go on with it"
        raise InputError(f"--out {out}: holds an experiment on stand-in sites; allowed: {allowed}")
    return StandIns.load(real, out) if asked else None


def _none_is_there(real: Path) -> bool:
    """Tells whether none of the real sites' files exists while stand-ins are described beside them."""
    described = (real.parent / DESCRIPTION).is_file()
    return described and not any(_is_there(site.file) for site in SitesConfig.load(real).site)


def _is_there(file: str) -> bool:
    try:
        return bool(find_data(file, "site"))
    except InputError:
        return False
