"""What the tests of painters share."""

import pytest


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Progress is told, and servers are asked, more often than users need it."""
    monkeypatch.setattr("gimp3d.priors.calls.TELL", 0.2)
    monkeypatch.setattr("gimp3d.priors.servers.POLL", 0.02)
