"""travjax: which of the trajectories in front of a wheeled robot will fail, and why.

    heights = travjax.generate_terrain("rough", range(32))   # or travjax.load_dem("site.tif").heights
    margins = travjax.simulate(heights)                      # step, obstacle, tilt margins of 3042 trajectories a map
    failed = travjax.label(heights)                          # [32, 3042, 3]
    probability = travjax.predict(heights)                   # likewise, by the hazard field in the package

    run = travjax.run_from_preset("mine.toml")               # the settings of an estimator of your own
    travjax.fit(run, "runs/mine")                            # trains it, in a folder
    scores = travjax.evaluate_run("runs/mine")               # tables and figures for its test maps
    predictor = travjax.Predictor.load("runs/mine")          # predictor.predict(heights).probability

Arrays, frames and units are in the module docstrings: grid.py for maps, actions.py for trajectories, traverse.py for
margins and failures.
"""

from importlib.metadata import version

import lazy_loader

__version__ = version("travjax")

# Names are imported at first use, because __main__.py has to set up logging before JAX is imported. A public name must
# not be the name of a module as well, because importing the module would hide it.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
