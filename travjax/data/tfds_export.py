"""The data set as a tensorflow-datasets builder, written as array_record and read without TensorFlow.

    export(dataset, "runs/tfds")
    source = tfds.builder("travjax", data_dir="runs/tfds").as_data_source("train")
    source[0]["elevation"]

One example is one map: `elevation` [rows, cols] float32 metres, NaN unknown; `labels` [t] uint8, a byte per trajectory
in which bits 0 to 2 mark failures by step, obstacle and tilt, bit 3 unknown ground, and bits 4 to 7 failures by further
events of the robot; `style`, or the site of a real map; `seed` of the terrain; `map`, the index in the data set; for a
real map also `origin` and `quarter_turns` as in provenance.py. Everything but the arrays is in the builder's metadata.
"""

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from travjax.config import InputError, read_json, require
from travjax.data.dataset import SPLITS, Dataset, configs_to_json, dataset_from_arrays
from travjax.files import atomic_write_folder, put_back, user_path

NAME, VERSION = "travjax", "1.0.0"

ARRAY_OF = {
    "elevation": "heights",
    "labels": "labels",
    "seed": "seed",
    "origin": "origin",
    "quarter_turns": "quarter_turns",
}
"""The array of a data set that each feature holds a row of."""

METADATA = "metadata.json"
"""The file in which tensorflow-datasets keeps a builder's metadata."""


def export(dataset: Dataset, folder: str | Path, on_progress: Callable[[int], object] | None = None) -> None:
    """Writes the data set in the format of tensorflow-datasets below `folder`, completely or not at all.

    An earlier export is replaced. on_progress is called with the number of maps that were added. Splits without maps
    are left out. Raises InputError when tensorflow-datasets is missing, when the folder holds something else, or when
    the data set cannot be written.
    """
    tfds = _tensorflow_datasets()
    with atomic_write_folder(user_path(folder), _is_export) as temporary:
        builder = _builder_class(tfds, dataset, on_progress)(data_dir=temporary, file_format="array_record")
        downloads, no_bucket = temporary / "downloads", tfds.download.DownloadConfig(try_download_gcs=False)
        tfds.disable_progress_bar()
        try:
            builder.download_and_prepare(download_dir=downloads, download_config=no_bucket)
        except RuntimeError as error:  # from the writer of array_record files
            raise InputError(f"{folder}: cannot be written: {' '.join(str(error).split())}") from None
        finally:
            tfds.enable_progress_bar()
        shutil.rmtree(downloads)


def read(folder: str | Path) -> Dataset:
    """Reads the data set that `export` wrote to `folder`; it equals the exported one.

    Raises InputError when tensorflow-datasets is missing, or when the data set is missing or damaged.
    """
    tfds = _tensorflow_datasets()
    folder = user_path(folder)
    put_back(folder)
    place = folder / NAME / VERSION
    require(_is_export(folder), "folder", str(folder), f"one with an exported data set in {NAME}/{VERSION}")
    try:
        builder = tfds.builder_from_directory(place)
        return dataset_from_arrays(builder.info.metadata, _collected(builder))
    except Exception as error:  # the reader may raise anything on a damaged record
        raise InputError(f"{place}: damaged: {' '.join(str(error).split()) or type(error).__name__}") from None


def _collected(builder: Any) -> dict[str, np.ndarray]:
    """Collects the arrays of the data set by name."""
    splits, features = builder.info.splits, builder.info.features
    count = sum(split.num_examples for split in splits.values())
    kept = {array: name for name, array in ARRAY_OF.items() if name in features}
    arrays = {array: np.empty((count, *features[name].shape), features[name].np_dtype) for array, name in kept.items()}
    split = np.full(count, len(SPLITS), np.uint8)  # not a split: marks maps that are missing
    group = [""] * count
    for name in splits:
        source = builder.as_data_source(name)
        for place in range(len(source)):
            example = source[place]
            index = example["map"]
            for array, feature in kept.items():
                arrays[array][index] = example[feature]
            group[index], split[index] = example["style"].decode(), SPLITS.index(name)
    return arrays | {"group": np.array(group), "split": split}


def _builder_class(tfds: Any, dataset: Dataset, on_progress: Callable[[int], object] | None) -> type:
    """Makes the builder class of one data set, in a function because its base class is imported only when needed."""

    class Information(tfds.core.DatasetInfo):
        def initialize_from_bucket(self) -> None:
            """Does nothing, so that no bucket on the network is asked for the data set."""

    class Travjax(tfds.core.GeneratorBasedBuilder, skip_registration=True):  # type: ignore[call-arg]
        name = NAME
        VERSION = tfds.core.Version(VERSION)

        def _info(self):
            features = {
                "elevation": tfds.features.Tensor(shape=dataset.grid.shape, dtype=np.float32, encoding="bytes"),
                "labels": tfds.features.Tensor(shape=(len(dataset.actions),), dtype=np.uint8, encoding="bytes"),
                "style": tfds.features.Text(),
                "seed": tfds.features.Scalar(np.uint32),
                "map": tfds.features.Scalar(np.int64),
            }
            if dataset.provenance:
                # Encoded other than as bytes, float64 numbers would lose half of their digits.
                features["origin"] = tfds.features.Tensor(shape=(2,), dtype=np.float64, encoding="bytes")
                features["quarter_turns"] = tfds.features.Scalar(np.uint8)
            return Information(
                builder=self,
                description="Elevation maps and which trajectories of a wheeled robot fail on them.",
                features=tfds.features.FeaturesDict(features),
                metadata=tfds.core.MetadataDict(configs_to_json(dataset)),
                disable_shuffling=True,
            )

        def _split_generators(self, dl_manager):
            members = {split: dataset.maps_of(split) for split in SPLITS}
            return {split: self._generate_examples(maps) for split, maps in members.items() if len(maps)}

        def _generate_examples(self, maps):
            for index in maps.tolist():
                yield index, _example(dataset, index)
                if on_progress:
                    on_progress(1)

        def _log_download_bytes(self) -> None:
            """Prints nothing."""

        _log_download_done = _log_download_bytes

    return Travjax


def _example(dataset: Dataset, index: int) -> dict[str, Any]:
    numbers = {name: dataset.arrays[array][index] for name, array in ARRAY_OF.items() if array in dataset.arrays}
    return numbers | {"style": str(dataset.group[index]), "map": index}


def _is_export(folder: Path) -> bool:
    """Tells whether the folder holds an exported data set and nothing else."""
    try:
        metadata = read_json(folder / NAME / VERSION / METADATA)
        described = isinstance(metadata, dict) and "travjax" in metadata
        return described and [path.name for path in folder.iterdir()] == [NAME]
    except (OSError, InputError):
        return False


def _tensorflow_datasets() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its dependencies warn about each other on import
        try:
            import tensorflow_datasets as tfds  # type: ignore[import-untyped]
        except ImportError as error:
            raise InputError(
                f"tensorflow-datasets cannot be imported ({error}); allowed: pip install 'travjax[tfds]'"
            ) from None
    return tfds
