"""The experiments, a program each: `python -m travjax.experiments.NAME`; experiments/NAME holds recorded results."""

from travjax.entry import quiet_xla

quiet_xla()  # here, since the programs import JAX at once
