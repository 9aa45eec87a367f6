"""What all tests share: checked annotations, the promises of docs/reliability.md and the counting of their cases."""

import signal

from support.checked import check_annotations

check_annotations()  # Before anything imports one of the packages.

pytest_plugins = ["support.promises"]


# A shell starts what it runs in the background with SIGINT ignored, which children inherit: tests send it.
signal.signal(signal.SIGINT, signal.default_int_handler)
