"""A page in headless Chromium, at a width of one's own: what `browser.js` finds in it."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

CHROMIUM = shutil.which("chromium")
_SCRIPT = Path(__file__).with_suffix(".js")


def opened(page, folder, width):
    """Open a copy of a page in a frame of that width, as windows have a least one."""
    script = f"<head><script>{_SCRIPT.read_text()}</script>"
    (folder / "copy.html").write_text(page.replace("<head>", script, 1))
    frame = folder / f"frame{width}.html"
    frame.write_text(
        f'<iframe id="f" src="copy.html" style="width:{width}px;height:900px;border:0"></iframe>'
        "<script>const f = document.getElementById('f');"
        "f.onload = () => document.body.append(f.contentDocument.getElementById('told'))</script>"
    )
    done = subprocess.run(
        [
            str(CHROMIUM),
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--allow-file-access-from-files",
            f"--user-data-dir={folder / 'profile'}",
            f"--window-size={width + 40},1000",
            "--virtual-time-budget=20000",
            "--dump-dom",
            frame.as_uri(),
        ],
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    told = re.search(r'<pre id="told">(.*?)</pre>', done.stdout, re.DOTALL)
    assert told is not None, done.stderr[-2000:]
    return json.loads(html.unescape(told[1]))
