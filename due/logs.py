"""Log lines of an app process, for people or for machines."""

import datetime as dt
import json
import logging
import re
import sys
import time
from typing import Literal

Format = Literal["console", "json"]
_USERINFO = re.compile(r"(?<=://)[^/\s]*@")


def without_passwords(text: str) -> str:
    """The text, with user and password of every URL replaced by `…`."""
    return _USERINFO.sub("…@", text)


class JsonFormatter(logging.Formatter):
    """One JSON object per line: time (UTC), level, app, logger, message and traceback."""

    def __init__(self, app_id: str) -> None:
        super().__init__()
        self._app_id = app_id

    def format(self, record: logging.LogRecord) -> str:
        """The line of one record."""
        line = {
            "time": dt.datetime.fromtimestamp(record.created, dt.UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "app": self._app_id,
            "logger": record.name,
            "message": without_passwords(record.getMessage()),
        }
        if record.exc_info:
            line["exception"] = without_passwords(self.formatException(record.exc_info))
        return json.dumps(line, ensure_ascii=False)


class ConsoleFormatter(logging.Formatter):
    """A line for people, followed by the traceback of an exception."""

    def __init__(self, app_id: str) -> None:
        super().__init__(f"%(asctime)s {app_id} %(levelname)s %(name)s: %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        """The line of one record."""
        return without_passwords(super().format(record))


class LogLimit:
    """Rate limit for errors that hostile data can provoke: ten at once, then one a second."""

    def __init__(self, logger: logging.Logger, *, burst: int = 10) -> None:
        self._logger = logger
        self._burst = burst
        self._left = float(burst)
        self._filled = time.monotonic()
        self._left_out = 0

    def error(self, text: str, *arguments: object, error: BaseException | None = None) -> None:
        """Log it, with the traceback of `error`, or count it."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + now - self._filled)
        self._filled = now
        if self._left < 1:
            self._left_out += 1
            return
        self._left -= 1
        more, self._left_out = self._left_out, 0
        more_text = f" ({more} such errors before it are only counted)" if more else ""
        self._logger.error("%s%s", text % arguments, more_text, exc_info=error)


def set_up(app_id: str, level: str, form: Format) -> None:
    """Write logs of this level and above to stderr."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(app_id) if form == "json" else ConsoleFormatter(app_id))
    logging.basicConfig(level=level.upper(), handlers=[handler])
