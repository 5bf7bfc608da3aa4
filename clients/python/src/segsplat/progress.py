"""A line on standard error that shows how far a scene is."""

from __future__ import annotations

import sys

from .types import Event

_WIDTH = 24


def show_bar(event: Event) -> None:
    """Draws the bar of an event over the one before it."""
    fraction = 1.0 if event.event == "done" else event.fraction
    full = round(_WIDTH * fraction)
    doing = f"{event.ahead} ahead" if event.event == "queued" else event.stage or event.event
    end = "\n" if event.is_last else ""
    bar = "#" * full + "." * (_WIDTH - full)
    sys.stderr.write(f"\r{bar} {fraction:4.0%} {doing:12}{end}")
    sys.stderr.flush()
