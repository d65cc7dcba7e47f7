"""Log lines of an app process, for people or for machines."""

import datetime as dt
import json
import logging
import sys
from typing import Literal

Format = Literal["console", "json"]


class JsonFormatter(logging.Formatter):
    """One JSON object per line: time (UTC), level, app, logger, message, and the trace of an exception."""

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
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def set_up(app_id: str, level: str, form: Format) -> None:
    """Write logs of this level and above to stderr."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        JsonFormatter(app_id)
        if form == "json"
        else logging.Formatter(f"%(asctime)s {app_id} %(levelname)s %(name)s: %(message)s")
    )
    logging.basicConfig(level=level.upper(), handlers=[handler])
