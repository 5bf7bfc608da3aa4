"""A scene is deleted by hand: asked first, by keys alone, and told plainly that it is for ever."""

from __future__ import annotations

import re
import urllib.error
import urllib.request

import pytest
from acts import open_scenes, post, settled
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect
from served import ROOT

SOURCE = ROOT / "tests/fixtures/splats/source.ply"


@pytest.fixture
def doomed(url: str) -> str:
    return post(url, [("splats", SOURCE.name, SOURCE.read_bytes())])


def there(url: str, scene: str) -> bool:
    try:
        with urllib.request.urlopen(f"{url}/v1/scenes/{scene}"):
            return True
    except urllib.error.HTTPError as error:
        assert error.code == 404, error
        return False


def test_a_scene_is_deleted_by_keys_after_a_question(page: Page, url: str, doomed: str) -> None:
    page.goto(f"{url}/#scene={doomed}")
    settled(page)
    open_scenes(page)
    name = f"Delete scene {doomed[:8]}"
    page.get_by_role("button", name=name).focus()
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog", name=f"{name}?")
    expect(dialog).to_be_visible()
    expect(dialog).to_have_accessible_description(re.compile("This cannot be undone"))
    # What does no harm has the focus, and the rest of the page has none.
    expect(dialog.get_by_role("button", name="Keep it")).to_be_focused()
    grave = [one for one in Axe().run(page).response["violations"]
             if one["impact"] in ("serious", "critical")]
    assert not grave, grave
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    expect(page.get_by_role("button", name=name)).to_be_focused()
    page.keyboard.press("Enter")
    page.keyboard.press("Enter")
    expect(dialog).to_be_hidden()
    assert there(url, doomed), "to keep it is to keep it"
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    expect(page.locator("#says")).to_have_text(f"Scene {doomed[:8]} is deleted.")
    assert not there(url, doomed)
    expect(page.locator(f"#scenes button[data-id='{doomed}']")).to_have_count(0)
    expect(page.locator("#stage")).to_be_hidden()
    assert doomed not in page.url
    expect(page.locator("#scenes-title")).to_be_focused()


def test_another_scene_stays_open(page: Page, url: str, splats: str, doomed: str) -> None:
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    open_scenes(page)
    page.get_by_role("button", name=f"Delete scene {doomed[:8]}").click()
    page.get_by_role("button", name="Delete for ever").click()
    expect(page.locator("#says")).to_have_text(f"Scene {doomed[:8]} is deleted.")
    expect(page.locator("#stage")).to_be_visible()
    assert splats in page.url and there(url, splats)


def test_a_scene_that_is_gone_already_is_said(page: Page, url: str, doomed: str) -> None:
    page.goto(url)
    button = page.get_by_role("button", name=f"Delete scene {doomed[:8]}")
    expect(button).to_be_visible()
    request = urllib.request.Request(f"{url}/v1/scenes/{doomed}", method="DELETE")
    with urllib.request.urlopen(request):
        pass
    button.click()
    page.get_by_role("button", name="Delete for ever").click()
    expect(page.locator("#says")).to_contain_text("no scene has the id")
