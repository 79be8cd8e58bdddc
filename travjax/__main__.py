"""`python -m travjax`, the same as the command `travjax`."""

import os


def main() -> int:
    """Runs the command line; returns the exit code."""
    # When it reads compiled code back from the cache, XLA logs an error over two tuning hints that are no processor
    # features ("+prefer-no-gather is not supported on the host machine"). Only fatal errors are left to print.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    from travjax.cli import main as run

    return run()


if __name__ == "__main__":
    raise SystemExit(main())
