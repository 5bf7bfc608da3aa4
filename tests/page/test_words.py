"""The page's own words: each key in each language, each one used, and the browser's language."""

from __future__ import annotations

import re

import pytest
from acts import window
from playwright.sync_api import Browser, Page, expect
from served import ROOT

VALUES = re.compile(r"\{(\w+)\}")
USED = re.compile(r"""\bt\(\s*'([^']+)'|data-t(?:-[a-z]+)?="([^"]+)\"""")
# Keys that are put together, by their beginnings, and those that are a word of the server.
MADE = ("stage.", "edit.")


@pytest.fixture
def table(page: Page, url: str) -> dict[str, list[str]]:
    page.goto(url)
    return page.evaluate("segsplat.TABLE")


def test_each_language_has_each_word(table: dict[str, list[str]]) -> None:
    assert len(table) > 100
    for key, row in table.items():
        assert len(row) == 3 and all(text.strip() for text in row), key
        values = [set(VALUES.findall(text)) for text in row]
        assert values[0] == values[1] == values[2], (key, values)
        english, german, chinese = row
        assert english.count("|") == german.count("|") <= 1 and "|" not in chinese, key
        assert ("n" in values[0]) or "|" not in english, key


def test_each_word_is_used_and_each_used_word_is_there(table: dict[str, list[str]]) -> None:
    sources = "".join(path.read_text() for path in sorted((ROOT / "web").iterdir())
                      if path.name != "words.js")
    used = {one or two for one, two in USED.findall(sources)}
    assert used - set(table) == set()
    idle = {key for key in table if not key.startswith(MADE) and f"'{key}'" not in sources
            and f'"{key}"' not in sources}
    # How well a word is known comes from the server.
    assert idle == {"unmeasured"}, idle


@pytest.mark.parametrize(("locale", "language", "place"), [
    ("en-GB", "en", 0), ("de-AT", "de", 1), ("zh-CN", "zh", 2), ("fr-FR", "en", 0)])
def test_the_page_speaks_the_browsers_language(
        browser: Browser, url: str, table: dict[str, list[str]], locale: str, language: str,
        place: int) -> None:
    page = window(browser, locale=locale)
    page.goto(url)
    expect(page.locator("html")).to_have_attribute("lang", language)
    expect(page.locator("#sample")).to_have_text(table["sample"][place])
    expect(page.locator("#view")).to_have_attribute("aria-label", table["view"][place])
    expect(page.locator("#says")).to_have_text(table["choose"][place])
    page.context.close()
