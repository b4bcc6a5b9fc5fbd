"""A report in a real browser: wide and narrow, light and dark; it is right and asks for nothing."""

import itertools
import json
import re
import shutil
import subprocess

import pytest

from support.reports import FULL, command, made

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

pytestmark = pytest.mark.skipif(
    BROWSER is None, reason="there is no chromium, chromium-browser or google-chrome")

WIDTHS = (1280, 390)
SCHEMES = {"dark": 0, "light": 1}
PAPERS = {"dark": "rgb(23, 24, 27)", "light": "rgb(255, 255, 255)"}

# Windows are no narrower than 500 px; a frame is as wide as it is told to be.
FRAME = """<!DOCTYPE html><body style="margin: 0"><pre id="told"></pre>
<iframe id="frame" src="{page}" style="border: 0; width: {width}px; height: 900px"></iframe>
<script>
document.getElementById("frame").onload = event => {{
  const page = event.target.contentDocument, root = page.documentElement;
  page.querySelectorAll("details").forEach(one => one.open = true);
  const boxes = [...page.querySelectorAll("body *")].filter(one => {{
    for (let box = one.parentElement; box; box = box.parentElement)
      if (["auto", "hidden", "scroll"].includes(getComputedStyle(box).overflowX)) return false;
    return one.getBoundingClientRect().right > root.clientWidth + 1;
  }});
  document.getElementById("told").textContent = JSON.stringify({{
    width: root.clientWidth, content: root.scrollWidth, beyond: boxes.map(one => one.outerHTML
      .slice(0, 80)), paper: getComputedStyle(page.body).backgroundColor,
    images: [...page.images].every(one => one.complete && one.naturalWidth > 0),
    drawings: [...page.querySelectorAll(".panels img")].every(
      one => one.getBoundingClientRect().height > 50),
  }});
}};
</script>"""


def browsed(place, *options):
    """Let the browser open a page; return what it prints."""
    return subprocess.run(
        [BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
         "--disable-dev-shm-usage", "--disable-background-networking", "--no-first-run",
         "--allow-file-access-from-files", "--enable-logging=stderr", "--v=0",
         "--virtual-time-budget=4000", "--window-size=1400,1000", *options, place.as_uri()],
        capture_output=True, text=True, timeout=120, check=True)


@pytest.mark.evidence
def test_the_report_is_right_wide_and_narrow_light_and_dark_and_printed(tmp_path):
    page, paper, frame = (tmp_path / name for name in ("report.html", "report.pdf", "frame.html"))
    code, _, err = command("report", made(tmp_path, FULL, "store"), "-o", page)
    assert (code, err) == (0, "")
    for width, (scheme, number) in itertools.product(WIDTHS, SCHEMES.items()):
        frame.write_text(FRAME.format(page=page.as_uri(), width=width))
        done = browsed(frame, "--dump-dom", f"--blink-settings=preferredColorScheme={number}")
        assert "CONSOLE" not in done.stderr
        told = json.loads(re.search(r'<pre id="told">(.*?)</pre>', done.stdout)[1])
        assert told["content"] <= width
        assert told == told | {"paper": PAPERS[scheme], "width": width, "beyond": [],
                               "images": True, "drawings": True}
    browsed(page, f"--print-to-pdf={paper}")
    assert paper.read_bytes()[:5] == b"%PDF-"
    assert paper.stat().st_size > 20_000
