"""Pages in headless Chromium, waited for until they show what a test looks for.

No test may depend on how fast a browser draws: on a slow machine, Chromium's virtual time runs out
before the first frame. ``answer_of`` waits for the page's own answer, ``pictured`` takes pictures
until one holds what is looked for.
"""

import json
import queue
import shutil
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from children import child, finished
from matplotlib import image

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
LONGEST = 120.0  # s that a page may take


def command(folder, *options):
    return [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        f"--user-data-dir={folder / 'profile'}", *options,
    ]  # fmt: skip


def answer_of(page, script, folder, *options):
    """What the last line of ``script`` gives, a promise in the page, and the page's complaints.

    ``script`` is the body of an ``async`` function that has ``until(holds)``.
    """
    hand = (
        "<script>(async () => { const until = (holds) => new Promise((done) => {"
        "const timer = setInterval(() => { if (holds()) { clearInterval(timer); done(); } }, 20);"
        "}); const answer = await (async () => {" + script + "})();"
        'await fetch("/", {method: "POST", body: JSON.stringify(answer)}); })()</script></body>'
    )
    page = hand.join(page.rsplit("</body>", 1)).encode()
    answers = queue.Queue()

    class Server(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(page if self.path == "/" else b"")

        def do_POST(self):
            answers.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_):
            pass

    log = folder / "browser.log"
    with HTTPServer(("127.0.0.1", 0), Server) as server, log.open("wb") as errors:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/"
        start = command(
            folder, "--enable-logging=stderr", "--remote-debugging-port=0", *options, address
        )
        with child(start, stderr=errors):
            answer = answers.get(timeout=LONGEST)
        server.shutdown()
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return answer, [line for line in lines if "CONSOLE" in line]


def pictured(path, folder, holds, *options):
    """The pixels (height, width, 3) of a file's page, from the first picture that ``holds``."""
    picture, end, virtual = folder / "picture.png", time.monotonic() + LONGEST, 3000
    while True:
        shown = (f"--virtual-time-budget={virtual}", f"--screenshot={picture}", path.as_uri())
        finished(command(folder, *options, *shown), longest=LONGEST, check=True)
        pixels = image.imread(picture)[..., :3]
        if holds(pixels) or time.monotonic() > end:
            assert holds(pixels)
            return pixels
        virtual *= 3
