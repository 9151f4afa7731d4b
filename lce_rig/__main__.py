"""`python -m lce_rig` is `lce-rig`."""

from lce_rig.cli.entry import main

main()
