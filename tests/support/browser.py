"""A headless Chromium for the tests of pages."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.support.needs import need


class Browser:
    """Headless Chromium over its debugging pipe: messages of JSON, each ended by a zero byte."""

    def __init__(self, program: str, folder: Path) -> None:
        to_browser, from_browser = os.pipe(), os.pipe()
        self._flags = [
            "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            "--disable-background-networking", "--no-first-run", f"--user-data-dir={folder}", "--remote-debugging-pipe",
        ]  # fmt: skip
        # Chromium reads descriptor 3 and writes descriptor 4. Both are moved through 10 and 11, lest one overwrite
        # the other on its way.
        command = f'exec 10<&{to_browser[0]} 11>&{from_browser[1]}; exec "$0" "$@" 3<&10 4>&11 10<&- 11>&-'
        self._process = subprocess.Popen(
            ["/bin/bash", "-c", command, program, *self._flags, "about:blank"],
            pass_fds=(to_browser[0], from_browser[1]), stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        os.close(to_browser[0])
        os.close(from_browser[1])
        self._write, self._read = os.fdopen(to_browser[1], "wb", 0), os.fdopen(from_browser[0], "rb")
        self._number, self._session = 0, ""

    def call(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._write.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = json.loads(self._message())
            if answer.get("id") == self._number:
                return answer["result"]

    def _message(self) -> bytes:
        message = bytearray()
        while (byte := self._read.read(1)) != b"\0":
            assert byte, "the browser closed its pipe"
            message += byte
        return bytes(message)

    def open(self, url: str, width: int, height: int) -> None:
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=url)

    def evaluate(self, expression: str) -> Any:
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression: str, seconds: float = 60) -> None:
        end = time.monotonic() + seconds
        while not self.evaluate(expression):
            assert time.monotonic() < end, self.evaluate("document.body.innerText")
            time.sleep(0.1)

    def picture(self) -> np.ndarray:
        """uint8 [H, W, 3], RGB."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def close(self) -> None:
        with contextlib.suppress(BrokenPipeError):
            self._write.write(json.dumps({"id": 0, "method": "Browser.close"}).encode() + b"\0")
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._write.close()
        self._read.close()


@contextlib.contextmanager
def running_browser(folder: Path) -> Iterator[Browser]:
    """Chromium with its profile in `folder`; skips the test where there is none."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    need("chromium", program and sys.platform == "linux", "no Chromium on the PATH")
    assert program
    browser = Browser(program, folder)
    try:
        yield browser
    finally:
        browser.close()
