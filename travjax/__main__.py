"""`python -m travjax`, the same as the command `travjax`."""

from travjax import signals


def main() -> int:
    """Runs the command line; returns the exit code."""
    signals.end_at_once()  # first, since NumPy and JAX take a second to import
    from travjax.entry import quiet_xla, settle_streams

    quiet_xla()
    settle_streams()
    from travjax.cli import main as run

    return run()


if __name__ == "__main__":
    raise SystemExit(main())
