"""A bridge needs no more rights than the documents say: it observes what it takes away and publishes what it brings."""

import secrets
from contextlib import ExitStack
from functools import partial

from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Engine, Options
from due.bridge.service import BridgeService, Settings
from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_rights import Rights
from due.private_files import write_private_json
from sdnator.rights.identities import ADMIN, credential_file, made
from tests.due.conftest import wait_for

KEY = "network.anomaly.kitsune.score"
PATTERN = "network.anomaly.**"
NEAR = {
    "kitsune": Rights(app="kitsune", publish=("network.anomaly.kitsune.*",)),
    "bridge": Rights(app="bridge", observe=(PATTERN,)),
}
FAR = {
    "reader": Rights(app="reader", observe=("network.anomaly.kitsune.*",)),
    "bridge": Rights(app="bridge", publish=(PATTERN,)),
}


def site(stack, folder, rights):
    """Options of each app of a site."""
    folder.mkdir()
    identities, password = made(folder, rights), secrets.token_urlsafe(24)
    server = stack.enter_context(
        EmbeddedServer(
            folder / "u",
            users=partial(identities.users_file, password),
            admin=(identities.prefix + ADMIN, password),
        )
    )
    return {
        name: credential_file(identities.url(server.url, name), "", identities.all[name]) for name in rights
    }


def joined(stack, app, options, role, **declared):
    engine = Engine(Options(coordinated=False, **options))
    engine.set_db("memory://bridge-rights")
    engine.init(app, role, **declared)
    stack.callback(engine.close)
    return engine


def test_reliable_items_cross_with_the_rights_of_the_documents(tmp_path):
    with ExitStack() as stack:
        near, far = site(stack, tmp_path / "near", NEAR), site(stack, tmp_path / "far", FAR)
        write_private_json(tmp_path / "far.json", far["bridge"])
        found = []
        joined(stack, "reader", far["reader"], CONSUMER).observe(KEY).subscribe(found.append)
        bridge = BridgeService(
            joined(stack, "bridge", near["bridge"], PRODUCER | CONSUMER),
            Settings(far=str(tmp_path / "far.json"), to_far=(PATTERN,)),
        )
        bridge.start()
        stack.callback(bridge.stop)
        forwarder = bridge._directions["to_far"]._forwarder
        forwarder.activate(True)  # no Coordinator runs that would say so
        forwarder.want([KEY])
        maker = joined(
            stack, "kitsune", near["kitsune"], PRODUCER, capabilities=[Capability(KEY, delivery="reliable")]
        )
        for number in range(100):
            maker.write(KEY, number, [PUB_ONLY])
        wait_for(lambda: len(found) == 100)
        assert [item.value for item in found] == list(range(100))
        wait_for(lambda: bridge.health()["to_far_unsettled"] == 0)
