"""The program `hyaline`: the commands of `datagen`, `proxies`, `model` and `report` under one name."""

import sys

import datagen.cli
import model.cli
import proxies.cli
from datagen.terminal.command import run
from datagen.terminal.parsing import CommandGroup, group
from eval.cli import report
from model.runtime import wait_briefly


def main() -> None:
    """Entry point of the console script."""
    wait_briefly()
    run("hyaline", commands(), sys.argv[1:])


def commands() -> CommandGroup:
    """All commands; a word that means one of a dataset and one of a run is a group of both."""
    of_data, of_runs = datagen.cli.commands(), model.cli.commands()
    data, runs = of_data.commands(), of_runs.commands()
    both = {
        word: group(f"{word.capitalize()} a dataset or a trained run.", {"dataset": data[word], "run": runs[word]})
        for word in data.keys() & runs.keys()
    }
    by_name = {**data, "proxies": proxies.cli.commands(), **runs, "report": report, **both}
    absent = {**of_data.absent, **of_runs.absent}
    return group("Datasets of transparent objects, neural renderers for them, and their evaluation.", by_name, absent)
