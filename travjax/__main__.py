"""`python -m travjax` is the command `travjax`."""

from travjax.cli import main

raise SystemExit(main())
