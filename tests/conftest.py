"""What all tests share: the promises of docs/reliability.md and the counting of their cases."""

pytest_plugins = ["support.promises"]
