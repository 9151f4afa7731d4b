"""Let `python -m lce_rig` run the command line."""

from lce_rig.cli.entry import main

main()
