"""``mvdyn config``."""

from __future__ import annotations

import argparse
import json

from rich.console import Console
from rich.table import Table

from mvdyn_gtsam.cli.arguments import add_config_arguments, read_config

SUMMARY = "list every setting, its value and where it comes from"
DESCRIPTION = """\
List every setting with its value, what it does and where its default comes from. With --config and --set,
check them and show what they lead to."""
EPILOG = """\
examples:
  mvdyn config
  mvdyn config --toml > mine.toml                a file to start from
  mvdyn config --config mine.toml                is it right?"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the verb."""
    add_config_arguments(parser)
    parser.add_argument("--toml", action="store_true", help="print a TOML file with the help as comments")


def run(arguments: argparse.Namespace, messages: Console) -> int:
    """Run the verb."""
    from mvdyn_gtsam.config import describe
    from mvdyn_gtsam.config_tree import describe_tree

    keys = describe_tree(read_config(arguments))
    defaults = {key.key: key.default for key in describe()}
    console = Console(highlight=False, markup=False)
    if arguments.toml:
        section = ""
        for key in keys:
            table, name = key.key.rsplit(".", 1)
            if table != section:
                console.print(f"[{table}]" if not section else f"\n[{table}]", soft_wrap=True)
                section = table
            # JSON values are TOML values here: numbers, strings, booleans and lists of them.
            console.print(f"# {key.doc}\n{name} = {json.dumps(key.default)}", soft_wrap=True)
        return 0
    table_view = Table("key", "value", "what it does", show_edge=False, pad_edge=False)
    for key in keys:
        changed = "" if key.default == defaults[key.key] else f" (default {json.dumps(defaults[key.key])})"
        table_view.add_row(key.key, json.dumps(key.default) + changed, key.doc)
    console.print(table_view)
    return 0
