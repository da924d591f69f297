"""`python -m trainer.sweep`."""

from trainer.sweep import main

main()
