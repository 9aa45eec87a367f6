"""Scores pictures on disk against a dataset's truth. Runs no network, imports neither torch nor Mitsuba."""
