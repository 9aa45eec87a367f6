"""What all tests share: the promises of docs/reliability.md and the counting of their cases."""

import signal

pytest_plugins = ["support.promises"]


# A shell starts what it runs in the background with SIGINT ignored, which children inherit: tests send it.
signal.signal(signal.SIGINT, signal.default_int_handler)
