"""How many examples property tests try; which profile counts is said in conftest.py."""

from __future__ import annotations

from typing import Any

from hypothesis import settings

USUAL = 100  # examples of a property test that does not say how many, in `make test`


def register_profiles() -> None:
    """`repeatable` tries the same examples in every run; `thorough` tries others each time, and five times as many."""
    settings.register_profile("repeatable", max_examples=USUAL, deadline=None, derandomize=True)
    settings.register_profile("thorough", max_examples=5 * USUAL, deadline=None, print_blob=True)


def examples(count: int, **options: Any) -> settings:
    """As many examples as said, times what the profile asks for: a plain max_examples would override it."""
    return settings(max_examples=count * settings().max_examples // USUAL, **options)
