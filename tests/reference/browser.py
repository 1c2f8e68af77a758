"""A real browser without a window, driven by the DevTools protocol over two pipes."""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from contextlib import closing

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((found for name in NAMES if (found := shutil.which(name))), None)
WAIT = 60
"""Seconds for any answer."""


def look_at(path, width, height, expression, profile):
    """{"requests": addresses asked for, "messages": errors and warnings, "value": of a JavaScript
    expression, "png": the whole page}.

    path: an HTML file.
    width, height: of the window, px.
    profile: an empty folder for the browser.
    """
    with closing(Browser(profile, width, height)) as page:
        page.open(path)
        value, png = page.run(expression), page.picture()
        return {"requests": page.requests, "messages": page.errors, "value": value, "png": png}


class Browser:
    """One page of a browser; `errors` collects what its console complains of."""

    def __init__(self, profile, width=1280, height=900):
        there, ours = os.pipe(), os.pipe()
        flags = "--headless=new --no-sandbox --disable-gpu --hide-scrollbars --no-first-run "
        flags += "--disable-dev-shm-usage"
        command = f'exec "$0" "$@" 3<&{there[0]} 4>&{ours[1]}'
        self.process = subprocess.Popen(
            ["bash", "-c", command, CHROMIUM, *flags.split(), f"--user-data-dir={profile}"]
            + ["--host-resolver-rules=MAP * ~NOTFOUND", "--remote-debugging-pipe", "about:blank"],
            env=os.environ | {"HOME": str(profile)},
            pass_fds=(there[0], ours[1]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(there[0])
        os.close(ours[1])
        self.send_to, self.read_from = there[1], ours[0]
        self.buffer, self.number, self.session, self.errors = b"", 0, None, []
        self.requests = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.resize(width, height)

    def call(self, method, **params):
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.send_to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self.receive()
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]

    def receive(self):
        until = time.monotonic() + WAIT
        while b"\0" not in self.buffer:
            ready, _, _ = select.select([self.read_from], [], [], max(0, until - time.monotonic()))
            assert ready, "the browser does not answer"
            self.buffer += os.read(self.read_from, 1 << 20)
        one, self.buffer = self.buffer.split(b"\0", 1)
        message = json.loads(one)
        self.listen(message.get("method"), message.get("params", {}))
        return message

    def listen(self, method, params):
        if method == "Runtime.exceptionThrown":
            self.errors.append(str(params["exceptionDetails"]))
        if method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.errors.append(params["entry"]["text"])
        if method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning"):
            self.errors.append(str(params["args"]))
        if method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def resize(self, width, height):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def open(self, path):
        self.call("Page.navigate", url=path.resolve().as_uri())
        self.wait("document.readyState === 'complete' && location.protocol === 'file:'")

    def run(self, script):
        answer = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait(self, condition):
        until = time.monotonic() + WAIT
        while not self.run(condition):
            assert time.monotonic() < until, f"never: {condition}"
            time.sleep(0.02)

    def mouse(self, kind, x, y):
        button = "none" if kind == "mouseMoved" and not self.held else "left"
        self.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=x,
            y=y,
            button=button,
            buttons=int(self.held),
            clickCount=1,
        )

    held = False

    def drag(self, *places):
        """Press at the first place (x, y), move through the others, and let go at the last."""
        self.mouse("mouseMoved", *places[0])
        self.held = True
        self.mouse("mousePressed", *places[0])
        for place in places[1:]:
            self.mouse("mouseMoved", *place)
        self.held = False
        self.mouse("mouseReleased", *places[-1])

    def key(self, key):
        for kind in ("keyDown", "keyUp"):
            text = {"text": key} if len(key) == 1 and kind == "keyDown" else {}
            self.call("Input.dispatchKeyEvent", type=kind, key=key, **text)

    def box(self, selector):
        """Left, top, width and height of an element on the screen, scrolled into view."""
        return self.run(
            f"(() => {{ const e = document.querySelector({selector!r}); "
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect(); "
            "return [b.left, b.top, b.width, b.height]; })()"
        )

    def picture(self):
        """PNG of the whole page."""
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        return base64.b64decode(shot["data"])

    def close(self):
        self.session = None
        os.write(
            self.send_to, json.dumps({"id": 10**9, "method": "Browser.close"}).encode() + b"\0"
        )
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(10)
        os.close(self.send_to)
        os.close(self.read_from)
