"""Rasters of GDAL: what they say of place, units and bands, and that a file given as data does not act."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import rasterio
from affine import Affine
from PIL import Image

from travjax.config import InputError
from travjax.rasters.gdal_files import DRIVERS, _FromFile, read_raster
from travjax.rasters.reading_options import DemOptions

CELL = 0.0625
WEST, SOUTH = 500_000.25, 5_000_000.5
"""Metres: the centre of the south-west value; EPSG:32632 is true to scale there."""

HEIGHTS = (np.arange(20 * 24).reshape(20, 24) / 64).astype(np.float32)
"""Metres, row 0 in the south."""


def write(path: Path, heights: np.ndarray = HEIGHTS, driver: str = "GTiff", south_up: bool = False, **options) -> Path:
    """Heights [rows, cols] with row 0 in the south, or bands of them, as a raster of GDAL."""
    bands = heights if heights.ndim == 3 else heights[None]
    count, rows, cols = bands.shape
    north = SOUTH + (rows - 1) * CELL
    place = Affine(CELL, 0, WEST - CELL / 2, 0, -CELL, north + CELL / 2)
    if south_up:
        place = Affine(CELL, 0, WEST - CELL / 2, 0, CELL, SOUTH - CELL / 2)
    profile = dict(driver=driver, width=cols, height=rows, count=count, dtype=bands.dtype, transform=place)
    units, names = options.pop("units", ()), options.pop("names", ())
    with rasterio.open(path, "w", **profile | options) as file:
        file.write(bands if south_up else bands[:, ::-1])
        if units:
            file.units = units
        if names:
            file.descriptions = names
    return path


def read(path: Path, **options) -> np.ndarray:
    raster = read_raster(path, DemOptions(**options))
    return raster.heights[0 : raster.heights.shape[0], 0 : raster.heights.shape[1]]


def refusal(path: Path, **options) -> str:
    with pytest.raises(InputError) as raised:
        read_raster(path, DemOptions(**options))
    assert len(str(raised.value).splitlines()) == 1
    return str(raised.value)


# ---- Place


def test_a_raster_that_runs_south_and_one_that_runs_north_are_the_same(tmp_path):
    for south_up in (False, True):
        raster = read_raster(write(tmp_path / "a.tif", south_up=south_up, crs="EPSG:32632"), DemOptions())
        np.testing.assert_array_equal(raster.heights[0:20, 0:24], HEIGHTS)
        assert raster.origin == pytest.approx((WEST, SOUTH), abs=1e-9)
        assert (raster.cell_size, raster.crs) == (CELL, "EPSG:32632")


def test_web_mercator_is_refused(tmp_path):
    place = Affine(CELL, 0, 1e6, 0, -CELL, 8_399_738)
    line = refusal(write(tmp_path / "a.tif", crs="EPSG:3857", transform=place))
    assert line.startswith("crs = EPSG:3857: a metre on the ground is 2 of its metres here, at 60 degrees north")


@pytest.mark.parametrize("crs", ["EPSG:4978", "EPSG:4936"])
def test_geocentric_systems_are_refused(tmp_path, crs):
    assert refusal(write(tmp_path / "a.tif", crs=crs)).startswith(f"crs = {crs}: is geocentric")


@pytest.mark.parametrize("data", ["/nonexistent", "."])
def test_the_database_of_the_environment_does_not_turn_feet_into_metres(tmp_path, data):
    path = write(tmp_path / "a.tif", crs="EPSG:2263")
    code = (
        "import sys; from pathlib import Path; from travjax.rasters.gdal_files import read_raster; "
        "from travjax.rasters.reading_options import DemOptions; read_raster(Path(sys.argv[1]), DemOptions())"
    )
    environment = os.environ | {"PROJ_DATA": data, "PROJ_LIB": data}
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, env=environment)
    assert "InputError: crs = EPSG:2263: is in units of 0.3048" in done.stderr.splitlines()[-1]


# ---- Pictures and bands


def test_a_picture_wants_both_scales_whatever_its_format(tmp_path):
    values = (HEIGHTS * 64).astype(np.uint16)
    for suffix in ("png", "pgm", "tif"):
        path = tmp_path / f"bare.{suffix}"
        Image.fromarray(values[::-1]).save(path)
        assert refusal(path, cell_size=CELL).startswith("height_scale is missing: a ")
        assert refusal(path, height_scale=1 / 64).startswith("cell_size is missing")
        raster = read_raster(path, DemOptions(cell_size=CELL, height_scale=1 / 64))
        np.testing.assert_array_equal(raster.heights[0:20, 0:24], HEIGHTS)
        assert raster.origin == (0, 0)


def test_jpeg_2000_wants_both_scales(tmp_path):
    path = tmp_path / "a.jp2"
    values = (HEIGHTS * 64).astype(np.uint16)
    profile = dict(driver="JP2OpenJPEG", width=24, height=20, count=1, dtype="uint16", QUALITY=100, REVERSIBLE="YES")
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning), rasterio.open(path, "w", **profile) as file:
        file.write(values[::-1], 1)
    assert refusal(path, cell_size=CELL).startswith("height_scale is missing: a JP2OpenJPEG holds no metres")
    np.testing.assert_array_equal(read(path, cell_size=CELL, height_scale=1 / 64), HEIGHTS)


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_grey_that_is_stored_as_colours_is_read(tmp_path, mode):
    grey = (np.arange(480).reshape(20, 24) % 251).astype(np.uint8)
    picture = Image.fromarray(grey[::-1]).convert(mode)
    if mode == "RGBA":
        opacity = np.full((20, 24), 255, np.uint8)
        opacity[0, 0] = 0  # the north-west
        picture.putalpha(Image.fromarray(opacity))
    picture.save(tmp_path / "a.png")
    assert refusal(tmp_path / "a.png", cell_size=CELL).startswith("height_scale is missing")
    expected = grey * 0.5
    if mode == "RGBA":
        expected[-1, 0] = np.nan
    np.testing.assert_array_equal(read(tmp_path / "a.png", cell_size=CELL, height_scale=0.5), expected)


def test_colours_are_refused(tmp_path):
    colours = np.random.default_rng(0).integers(0, 255, (20, 24, 3), np.uint8)
    Image.fromarray(colours).save(tmp_path / "a.png")
    assert refusal(tmp_path / "a.png", cell_size=CELL, height_scale=1).startswith(
        "bands = 3: must be 1, or one of them"
    )


def test_a_band_is_chosen_by_number_or_name(tmp_path):
    path = write(tmp_path / "a.tif", np.stack([HEIGHTS, HEIGHTS + 100]), names=("slope", "elevation"))
    assert refusal(path) == "bands = 2: must be 1, or one of them named (slope, elevation): give it (--band 1 to 2)"
    for band in (2, "2", "elevation"):
        np.testing.assert_array_equal(read(path, band=band), HEIGHTS + 100)
    assert refusal(path, band=3) == "--band = 3: must be at most 2, the number of bands"
    assert refusal(path, band="height") == "--band = 'height': must be one of slope, elevation"


@pytest.mark.parametrize("driver", ["GTiff", "HFA"])
def test_a_band_in_feet_wants_its_scale(tmp_path, driver):
    path = write(tmp_path / f"a.{'tif' if driver == 'GTiff' else 'img'}", driver=driver)
    with rasterio.open(path, "r+") as file:
        file.units = ("ft",)
    assert refusal(path).startswith("band 1: has heights in units of 0.3048 m (ft)")
    np.testing.assert_allclose(read(path, height_scale=0.3048), HEIGHTS.astype(float) * 0.3048, rtol=1e-12)


# ---- netCDF


def write_netcdf(path: Path, **variables: tuple[np.ndarray, str]) -> Path:
    """Variables (heights with row 0 in the south, unit) on axes in metres, as netCDF 4."""
    with h5py.File(path, "w") as file:
        for name, first, count in (("y", SOUTH, 20), ("x", WEST, 24)):
            axis = file.create_dataset(name, data=first + CELL * np.arange(count))
            axis.make_scale(name)
            axis.attrs["units"] = "m"
            axis.attrs["standard_name"] = f"projection_{name}_coordinate"
        for name, (heights, unit) in variables.items():
            variable = file.create_dataset(name, data=heights)
            variable.attrs["units"] = unit
            for k, axis in enumerate(("y", "x")):
                variable.dims[k].attach_scale(file[axis])
    return path


def test_a_variable_of_a_netcdf_is_read_by_its_name(tmp_path):
    path = write_netcdf(tmp_path / "a.nc", z=(HEIGHTS, "m"), depth=(HEIGHTS + 5, "cm"))
    raster = read_raster(path, DemOptions(band="z"))
    np.testing.assert_array_equal(raster.heights[0:20, 0:24], HEIGHTS)
    assert raster.origin == pytest.approx((WEST, SOUTH), abs=1e-6)
    assert refusal(path).startswith("--band = None: must be a variable of the file: ")
    assert refusal(path, band="q").startswith("--band = 'q': must be a variable of the file: ")
    assert refusal(path, band="depth").startswith("band 1: has heights in units of 0.01 m (cm)")


def test_a_raw_raster_that_is_cut_short_is_refused(tmp_path):
    path = write(tmp_path / "a.img", driver="ENVI")
    np.testing.assert_array_equal(read(path), HEIGHTS)
    path.write_bytes(path.read_bytes()[:-40])
    assert refusal(path).startswith(f"bytes = {HEIGHTS.nbytes - 40}: must be at least {HEIGHTS.nbytes}")


def test_depths_of_a_netcdf_are_refused(tmp_path):
    path = write_netcdf(tmp_path / "a.nc", z=(HEIGHTS, "m"))
    with h5py.File(path, "r+") as file:
        file["z"].attrs["positive"] = "down"
    assert refusal(path).startswith("band 1: holds depths, which run down")


def test_a_name_that_is_no_utf8_is_one_line(tmp_path):
    path = write(tmp_path / "a.tif").rename(os.fsdecode(os.fsencode(tmp_path) + b"/nam\xffe.tif"))
    assert refusal(path) == "name: must be UTF-8, which GDAL wants; rename the file"


def test_a_netcdf_in_degrees_is_refused_without_a_coordinate_system_too(tmp_path):
    with h5py.File(tmp_path / "a.nc", "w") as file:
        for name, first, count, unit in (("lat", 46.0, 20, "degrees_north"), ("lon", 7.0, 24, "degrees_east")):
            axis = file.create_dataset(name, data=first + CELL * np.arange(count))
            axis.make_scale(name)
            axis.attrs["units"] = unit
        variable = file.create_dataset("z", data=HEIGHTS)
        for k, axis in enumerate(("lat", "lon")):
            variable.dims[k].attach_scale(file[axis])
    assert refusal(tmp_path / "a.nc").endswith(": is in degrees; reproject it to metres (a UTM zone, say)")


def test_an_opacity_beside_heights_is_no_band_to_choose(tmp_path):
    opacity = np.full_like(HEIGHTS, 255)
    opacity[0, 0] = 0
    path = write(tmp_path / "a.tif", np.stack([HEIGHTS, opacity]), alpha="yes")
    expected = HEIGHTS.copy()
    expected[0, 0] = np.nan
    np.testing.assert_array_equal(read(path), expected)


def test_a_netcdf_of_one_variable_needs_no_name(tmp_path):
    np.testing.assert_array_equal(read(write_netcdf(tmp_path / "a.nc", z=(HEIGHTS, "m"))), HEIGHTS)


# ---- Files that refer to others

VRT = """<VRTDataset rasterXSize="24" rasterYSize="20"><GeoTransform>0,0.0625,0,20,0,-0.0625</GeoTransform>
<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="0">{}</SourceFilename>
<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"""


def test_no_driver_that_refers_to_other_files_is_asked():
    others = {"VRT", "WMS", "WMTS", "WCS", "HTTP", "STACIT", "STACTA", "PLMOSAIC", "EEDAI", "GTI", "Zarr", "ERS", "XYZ"}
    assert not others & set(DRIVERS)


@pytest.mark.parametrize("suffix", ["tif", "png", "vrt", "asc"])
def test_a_vrt_reads_no_other_file_whatever_it_is_called(tmp_path, suffix):
    path = tmp_path / f"evil.{suffix}"
    path.write_text(VRT.format(write(tmp_path / "other.tif")))
    assert refusal(path).startswith("not a raster that can be read: ")
    np.testing.assert_array_equal(read(path, gdal_drivers=("VRT",)), HEIGHTS)


def test_a_driver_that_gdal_does_not_have_is_refused(tmp_path):
    path = write(tmp_path / "a.tif")
    np.testing.assert_array_equal(read(path, gdal_drivers=("vrt",)), HEIGHTS)
    assert refusal(path, gdal_drivers=("VRT", "VTR")) == (
        "gdal_drivers = 'VTR': must be a driver of GDAL by its short name, such as BAG, of those that rasterio was "
        "built with"
    )


@pytest.mark.parametrize("name", ["a.tif.msk", "a.msk", "a.tif.ovr"])
def test_what_gdal_would_open_beside_a_raster_must_be_a_tiff(tmp_path, name):
    path = write(tmp_path / "a.tif")
    (tmp_path / name).write_text(VRT.format("/vsicurl/http://127.0.0.1:9/a.tif"))
    assert refusal(path) == f"{tmp_path / name} beside it: must be a TIFF, or not be there: GDAL would open it"


def test_a_netcdf_whose_data_lie_in_another_file_is_refused(tmp_path):
    HEIGHTS.tofile(tmp_path / "secret.bin")
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file.create_dataset(
            "z", shape=HEIGHTS.shape, dtype="f4", external=[(tmp_path / "secret.bin", 0, HEIGHTS.nbytes)]
        )
    assert refusal(tmp_path / "a.nc") == "z: keeps its data in another file; allowed: data of its own"
    with h5py.File(tmp_path / "b.nc", "w") as file:
        file["deep/z"] = h5py.ExternalLink("a.nc", "z")
    assert refusal(tmp_path / "b.nc").startswith("deep/z: is a link to another file, 'a.nc'")


# ---- Large files


def test_a_large_raster_is_read_from_the_file_part_by_part(tmp_path, monkeypatch):
    monkeypatch.setattr("travjax.rasters.gdal_files.WHOLE", 100)
    marked = HEIGHTS.copy()
    marked[3, 5] = -9999
    for south_up in (False, True):
        heights = read_raster(write(tmp_path / "a.tif", marked, south_up=south_up, nodata=-9999), DemOptions()).heights
        assert isinstance(heights, _FromFile)
        expected = np.where(marked == -9999, np.nan, HEIGHTS)
        np.testing.assert_array_equal(heights[2:7, 3:20], expected[2:7, 3:20])
        np.testing.assert_array_equal(heights[0:20, 0:24], expected)


def test_a_grid_as_text_keeps_all_digits(tmp_path):
    path = tmp_path / "a.asc"
    path.write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n2000.12345 1\n2 3\n")
    assert read(path)[1, 0] == 2000.12345
