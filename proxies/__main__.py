"""Runs `python -m proxies` as the console script does."""

from proxies.cli import main

main()
