"""`python -m nbavatar <verb> ...` is the same as `nbavatar <verb> ...`."""

from nbavatar.cli import main

raise SystemExit(main())
