"""A page as headless Chromium shows it, through the DevTools protocol: what it asked for, what
it complained about, a picture of it.
"""

import asyncio
import base64
import contextlib
import json
import os
import shutil
import signal
import subprocess
from pathlib import Path

CHROMIUM = next(
    (
        found
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (found := shutil.which(name))
    ),
    None,
)
WAIT = 60
"""Seconds for any answer."""


def look_at(path, width, height, expression, profile):
    """{"requests": addresses asked for, "messages": what the console said, "value": of a JavaScript
    expression, "png": the whole page}.

    path: an HTML file;
    width, height: of the window, px;
    profile: an empty folder for the browser.
    """
    command = [
        CHROMIUM,
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--no-first-run",
        "--hide-scrollbars",
        "--host-resolver-rules=MAP * ~NOTFOUND",
        f"--user-data-dir={profile}",
        "--remote-debugging-port=0",
        "about:blank",
    ]
    with open(Path(profile) / "log", "wb") as log:
        child = subprocess.Popen(
            command,
            stdout=log,
            stderr=log,
            start_new_session=True,
            env=os.environ | {"HOME": str(profile)},
        )
        try:
            return asyncio.run(
                asyncio.wait_for(
                    _look(Path(path), width, height, expression, Path(profile)), 3 * WAIT
                )
            )
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()


async def _look(path, width, height, expression, profile):
    from tornado.httpclient import AsyncHTTPClient
    from tornado.websocket import websocket_connect

    known = profile / "DevToolsActivePort"
    for _ in range(WAIT * 10):
        if known.exists() and known.read_text().count("\n"):
            break
        await asyncio.sleep(0.1)
    port = known.read_text().splitlines()[0]
    tabs = json.loads((await AsyncHTTPClient().fetch(f"http://127.0.0.1:{port}/json")).body)
    socket = await websocket_connect(
        next(t["webSocketDebuggerUrl"] for t in tabs if t["type"] == "page"),
        max_message_size=1 << 28,
    )
    events, number = [], 0

    async def hear():
        told = json.loads(await asyncio.wait_for(socket.read_message(), WAIT))
        events.append(told)
        return told

    async def ask(method, **parameters):
        nonlocal number
        number += 1
        await socket.write_message(
            json.dumps({"id": number, "method": method, "params": parameters})
        )
        while (told := await hear()).get("id") != number:
            pass
        assert "error" not in told, told
        return told["result"]

    for domain in ("Page", "Network", "Runtime", "Log"):
        await ask(f"{domain}.enable")
    await ask(
        "Emulation.setDeviceMetricsOverride",
        width=width,
        height=height,
        deviceScaleFactor=1,
        mobile=width < 600,
    )
    await ask("Page.navigate", url=path.resolve().as_uri())
    while not any(e.get("method") == "Page.loadEventFired" for e in events):
        await hear()
    value = await ask(
        "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
    )
    shot = await ask("Page.captureScreenshot", format="png", captureBeyondViewport=True)
    socket.close()
    return {
        "requests": [
            e["params"]["request"]["url"]
            for e in events
            if e.get("method") == "Network.requestWillBeSent"
        ],
        "messages": [
            e
            for e in events
            if e.get("method")
            in ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown")
        ],
        "value": value["result"]["value"],
        "png": base64.b64decode(shot["data"]),
    }
