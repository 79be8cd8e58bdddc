"""`python -m travjax`, the same as the command `travjax`."""

from travjax.entry import quiet_xla


def main() -> int:
    """Runs the command line; returns the exit code."""
    quiet_xla()
    from travjax.cli import main as run

    return run()


if __name__ == "__main__":
    raise SystemExit(main())
