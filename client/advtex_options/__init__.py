"""What a user may ask for, described once: standard library only, but for `flags`, which needs typer.

options.py   every option: its type, default, bounds, help and how the page shows it
box.py       a box in the world, which one of them is
words.py     presets by name, with their help
methods.py   texturing methods: a record of each, also of other packages'
flags.py     the options as flags of a command line

The API (`advtex_contract.options`), the engine's configuration (`advtex_engine.core.config`), the page's form, all
three command lines and the columns of a batch's manifest are made of it.
"""

from advtex_options.options import SIZE, Described, Options, described, parse_size, refusal

__all__ = ["SIZE", "Described", "Options", "described", "parse_size", "refusal"]
