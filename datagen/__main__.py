"""Runs `python -m datagen` as the console script does."""

from datagen.cli import main

main()
