"""Runs a .stablehlo file of `travjax export` without travjax: run_exported.py FILE HEIGHTS.npy [b, rows, cols]."""

import json
import sys
from pathlib import Path

import jax
import numpy as np
from jax import export

file, heights = sys.argv[1:]
about = json.loads(Path(f"{file}.json").read_text())
function = jax.jit(export.deserialize(bytearray(Path(file).read_bytes())).call)
results = function(np.load(heights).astype(np.float32))

print(f"{about['function']} for {about['robot']['name']}")
for name in ("grid", "actions", "contact", "events", "limits", "travjax", "jax"):
    print(f"{name}: {about[name]}")
for name, array in results.items():
    print(f"{name}: {about['outputs'][name]}; here {list(array.shape)}, mean {np.nanmean(array):.3f}")
