"""`python -m lce_rig` is `lce-rig`."""

from lce_rig.cli.main import main

main()
