"""The experiments, a program each: `python -m travjax.experiments.NAME`; experiments/NAME holds recorded results."""

import sys

from travjax.entry import quiet_xla, settle_streams
from travjax.signals import end_at_once

quiet_xla()  # done here because the programs import JAX at once
if sys.argv[:1] == ["-m"]:  # Python is still looking for the program to run
    end_at_once()
    settle_streams()
