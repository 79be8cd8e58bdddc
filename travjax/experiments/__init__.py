"""The experiments, one program each: `python -m travjax.experiments.NAME`; experiments/NAME holds recorded results.

In: presets, sites, trained runs. Out: a report with tables, figures and all numbers as JSON, in a folder.
Stands on training/, runs/, evaluation/ and all that these stand on.
"""

import sys

from travjax.entry import quiet_xla, settle_streams
from travjax.signals import end_at_once

quiet_xla()  # done here because the programs import JAX at once
if sys.argv[:1] == ["-m"]:  # Python is still looking for the program to run
    end_at_once()
    settle_streams()
