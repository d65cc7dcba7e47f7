"""The enforcer `webhook_enforcer` as a DUE app: blocks of the firewall at an HTTP server that answers."""

import sys
from collections.abc import Sequence
from urllib.parse import urlsplit

import due.service
from apps.enforcers.enforcer_app import ENFORCER_WANTS, EnforcerApp, enforcer_makes, place_name
from apps.enforcers.webhook_enforcer.http_client import SignedHttpClient, read_secret
from apps.enforcers.webhook_enforcer.settings import Settings
from apps.enforcers.webhook_enforcer.webhook import Webhook
from due import Engine
from due.errors import InvalidOption

INTERESTS = ENFORCER_WANTS
CAPABILITIES = enforcer_makes("webhook_enforcer")


class WebhookEnforcerService(EnforcerApp):
    """Posts blocks to one URL.  Raises `InvalidOption` without a URL, or for a secret that cannot be used."""

    def __init__(self, engine: Engine, settings: Settings) -> None:
        if not settings.url:
            raise InvalidOption("webhook_enforcer.url: name the server that blocks are posted to")
        client = SignedHttpClient(
            settings.url, read_secret(settings.secret_file), settings.ca_file, settings.timeout_s
        )
        super().__init__(
            engine,
            "webhook_enforcer",
            place_name(settings.place or urlsplit(settings.url).hostname or ""),
            Webhook(client),
            check_s=settings.check_s,
            patience_s=settings.patience_s,
            size=settings.queue,
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the enforcer until it is stopped."""
    return due.service.run(
        "webhook_enforcer", WebhookEnforcerService, Settings, INTERESTS, CAPABILITIES, argv
    )


if __name__ == "__main__":
    sys.exit(main())
