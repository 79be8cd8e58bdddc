"""ImageNet weights that are fetched once, converted and kept in the user's cache.

They are the weights of `keras.applications.ResNet50`, which Keras converted from those of the ResNet's authors (MIT
licence): a v1 network with its strides in the 1x1 convolutions, like the trunk of every preset and the paper's network.
The ResNet50s of timm, Microsoft and others on the Hugging Face hub are v1.5, which is a different network.
"""

import hashlib
import http.client
import urllib.request
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from travjax import progress
from travjax.config import InputError, one_line
from travjax.files import atomic_write, cache_folder
from travjax.resnet.imagenet_weights import load_weights, save_safetensors

URL = (
    "https://storage.googleapis.com/tensorflow/keras-applications/resnet/"
    "resnet50_weights_tf_dim_ordering_tf_kernels_notop.h5"
)
SIZE = 94_765_736
MD5 = "4d473c1dd8becc155b73f8504c6f6626"
"""Size in bytes and checksum of the file, the latter from keras/src/applications/resnet.py."""

KEPT = "weights/resnet50_keras.safetensors"
"""Path of the converted file within the cache."""

TIMEOUT = 30
"""Seconds without an answer after which the download is given up."""

PIECE = 1 << 18


def fetched_weights() -> Path:
    """Returns the file in the cache, and first fetches, checks and converts it if it does not exist yet.

    Raises InputError when it cannot be fetched or written, is not the expected file, or h5py is missing.
    """
    cache = cache_folder()
    if cache is None:
        raise InputError("there is no folder for a cache: XDG_CACHE_HOME or HOME must name one")
    kept = cache / KEPT
    if kept.is_file():
        return kept
    if find_spec("h5py") is None:
        raise InputError("converting them needs h5py: pip install h5py")
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{kept.parent}: cannot be written: {error.strerror}") from None
    progress.say(one_line(f"Fetching the ImageNet weights of Keras, {SIZE / 1e6:.0f} MB, to keep them in {kept}"))
    with atomic_write(kept) as temporary:
        source = temporary.with_name(URL.rpartition("/")[2])
        _download(source)
        save_safetensors(load_weights(source), temporary)
    return kept


def _download(path: Path) -> None:
    """Downloads the file at URL, with a progress bar; raises InputError when it is not the expected one."""
    digest, size = hashlib.md5(usedforsecurity=False), 0
    with path.open("wb") as file, progress.bar("ImageNet weights", SIZE, "B", unit_scale=True) as bar:
        for piece in _pieces():
            file.write(piece)
            digest.update(piece)
            size += len(piece)
            bar.update(len(piece))
    if (size, digest.hexdigest()) != (SIZE, MD5):
        raise InputError(f"{URL}: {size:,} bytes came, or another MD5: must be {SIZE:,} of {MD5}")


def _pieces() -> Iterator[bytes]:
    """Yields what the server sends; raises InputError when it sends nothing, or stops."""
    try:
        with urllib.request.urlopen(URL, timeout=TIMEOUT) as answer:
            while piece := answer.read(PIECE):
                yield piece
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", None) or error
        raise InputError(f"{URL}: cannot be fetched: {one_line(reason) or type(error).__name__}") from None
