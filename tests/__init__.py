"""Tests of travjax; a package, so that `python -m tests.fuzz` is ours and not that of an installed package."""
