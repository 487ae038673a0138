"""How many frames a second the page of sand draws while it is orbited, in headless Chromium without a graphics card.

    python -m tests.viz.frames [WIDTH,HEIGHT ...]

Needs chromium, and tornado, which comes with the extra `docs`.
"""

import argparse
import asyncio
import json
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np

import jaxsand as js

SECONDS = 5
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--remote-allow-origins=*",
)
ORBIT = """new Promise(done => {
  const canvas = document.querySelector("canvas"), box = canvas.getBoundingClientRect();
  const drawn = () => Number(document.querySelector("[data-drawn]").dataset.drawn);
  const send = (type, x, y) => canvas.dispatchEvent(new PointerEvent(type, {
    bubbles: true, isPrimary: true, pointerId: 1, buttons: 1,
    clientX: box.x + box.width / 2 + x, clientY: box.y + box.height / 2 + y}));
  const before = drawn(), start = performance.now();
  let moves = 0;
  const move = () => {
    send("pointermove", 100 * Math.sin(++moves / 20), 40 * Math.cos(moves / 20));
    const seconds = (performance.now() - start) / 1000;
    if (seconds < SECONDS) requestAnimationFrame(move);
    else done({rate: (drawn() - before) / seconds, width: canvas.width, height: canvas.height});
  };
  send("pointerdown", 0, 0);
  requestAnimationFrame(move);
})"""


def frames(size: str, page: Path, folder: Path) -> dict[str, float]:
    """The frames a second in a window of this size, and the canvas's size in pixels."""
    command = ["chromium", *OPTIONS, f"--user-data-dir={folder}", f"--window-size={size}", page.as_uri()]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as browser:
        try:
            port, started = folder / "DevToolsActivePort", time.monotonic()
            while not port.exists() and time.monotonic() - started < 30:
                time.sleep(0.1)
            time.sleep(3)  # the page is drawn
            number = int(port.read_text(encoding="utf-8").split()[0])
            return asyncio.run(_asked(number, ORBIT.replace("SECONDS", str(SECONDS))))
        finally:
            browser.terminate()


async def _asked(port: int, expression: str) -> Any:
    """What the browser's page says the expression's promise is."""
    from tornado.websocket import websocket_connect

    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
        (url,) = (tab["webSocketDebuggerUrl"] for tab in json.load(answer) if tab["type"] == "page")
    link = await websocket_connect(url)
    asked = {"expression": expression, "awaitPromise": True, "returnByValue": True}
    await link.write_message(json.dumps({"id": 1, "method": "Runtime.evaluate", "params": asked}))
    while True:
        message = json.loads(await link.read_message() or "{}")
        if message.get("id") == 1:
            return message["result"]["result"]["value"]


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.viz.frames", description=__doc__.splitlines()[0])
    parser.add_argument("sizes", nargs="*", default=["1400,1000", "390,844"], metavar="WIDTH,HEIGHT")
    film = np.cumsum(np.random.default_rng(0).normal(0, 1e-4, (100, 64, 64)), axis=0)
    for size in parser.parse_args().sizes:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            page = Path(folder) / "film.html"
            js.view(film, spacing=0.01).to_html(page)
            found = frames(size, page, Path(folder) / "browser")
            kilobytes = page.stat().st_size / 1000
        print(f"{found['rate']:.1f} frames/s of {found['width']:.0f} x {found['height']:.0f} pixels, {kilobytes:.0f} kB")


if __name__ == "__main__":
    main()
