"""Runs `python -m hyaline` as the console script does."""

from hyaline.cli import main

main()
