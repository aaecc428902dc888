"""A headless browser for the tests: found where there is one, spoken to over a pipe by the DevTools protocol."""

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import time

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PROGRAM = os.environ.get("JAXKANE_BROWSER") or next(filter(None, map(shutil.which, NAMES)), None)
WHY_NOT = f"no browser: none of {', '.join(NAMES)} is on the PATH, nor named by JAXKANE_BROWSER (see .ci/browser)"
_FLAGS = "--headless --no-sandbox --no-zygote --disable-gpu --disable-dev-shm-usage --hide-scrollbars".split()


class Page:
    """One page of a browser of its own; ends with the `with` block. Errors of the page's script are gathered."""

    def __init__(self, folder, width=900, height=560):
        read_by_browser, self._to = os.pipe()
        self._from, written_by_browser = os.pipe()
        # The browser reads from descriptor 3 and writes to 4.
        run = f'exec "$0" "$@" 3<&{read_by_browser} 4>&{written_by_browser}'
        self._process = subprocess.Popen(
            ["bash", "-c", run, PROGRAM, *_FLAGS, "--remote-debugging-pipe", f"--user-data-dir={folder}"],
            pass_fds=(read_by_browser, written_by_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read_by_browser)
        os.close(written_by_browser)
        self._rest, self._number, self._session, self.errors = b"", 0, None, []
        target = self("Target.createTarget", url="about:blank")["targetId"]
        self._session = self("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self("Runtime.enable")
        self("Page.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self("Emulation.setDeviceMetricsOverride", **size)

    def __call__(self, method, **params):
        """One command of the protocol and its answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next(method)
            if answer.get("method") == "Runtime.exceptionThrown":
                self.errors.append(answer["params"]["exceptionDetails"]["exception"].get("description", "?"))
            if answer.get("id") == self._number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def _next(self, method, timeout=300.0):
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._from], [], [], timeout)
            part = os.read(self._from, 1 << 20) if ready else b""
            assert part, f"the browser does not answer {method}"
            self._rest += part
        message, self._rest = self._rest.split(b"\0", 1)
        return json.loads(message)

    def show(self, path, dark=False):
        """Opens a file, for a reader who prefers dark or light pages."""
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self("Emulation.setEmulatedMedia", features=[scheme])
        self("Page.navigate", url=path.resolve().as_uri())
        self.wait("document.readyState === 'complete'")

    def value(self, expression):
        """The value of an expression of JavaScript in the page."""
        result = self("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, expression, seconds=120.0):
        """Until an expression is true."""
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f"never true: {expression}; errors: {self.errors}"
            time.sleep(0.05)

    def key(self, key):
        for kind in ("keyDown", "keyUp"):
            self("Input.dispatchKeyEvent", type=kind, key=key)

    def mouse(self, kind, x, y, **more):
        self("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def screenshot(self, path):
        path.write_bytes(base64.b64decode(self("Page.captureScreenshot")["data"]))
        return path

    def __enter__(self):
        return self

    def __exit__(self, *_):
        with contextlib.suppress(OSError):
            os.close(self._to)
        self._process.kill()
        self._process.wait()
        os.close(self._from)
