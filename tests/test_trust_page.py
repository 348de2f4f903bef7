"""docs/trust.md says what the tests do."""

from __future__ import annotations

from tests.trust_page import PAGE, page


def test_the_page_is_up_to_date() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "python -m tests.trust_page writes it anew"
