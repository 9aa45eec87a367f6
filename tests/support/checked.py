"""How annotations are checked while tests run: by beartype, where an int is a float, too (PEP 484's numeric tower)."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
