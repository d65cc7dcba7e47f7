"""The file of identities: what cannot be read is not made anew."""

import pytest

from due.drivers.embedded_redis import EmbeddedServer
from due.drivers.redis_rights import Rights
from due.drivers.redis_wire import client
from sdnator.errors import BadInput
from sdnator.rights.identities import Identities, made
from sdnator.rights.rights_keeper import RightsKeeper
from tests.due.conftest import wait_for


def test_a_file_that_cannot_be_read_is_named_and_kept(tmp_path):
    """It may be whole, and new identities would lock out every app that was enrolled."""
    path = Identities(tmp_path).path
    path.mkdir()  # can be read by nobody, root included
    for use in (Identities, lambda folder: made(folder, {"kitsune": Rights(app="kitsune")})):
        with pytest.raises(BadInput, match=r"identities\.json: cannot be read .*chown"):
            use(tmp_path)
    assert path.is_dir()


def test_a_damaged_file_is_made_anew(tmp_path):
    """The pipeline starts all the same; apps that run elsewhere must be enrolled again."""
    made(tmp_path, {"kitsune": Rights(app="kitsune")}).path.write_text("{")
    assert set(made(tmp_path, {"kitsune": Rights(app="kitsune")}).all) == {"kitsune", "operator"}


def test_the_keeper_of_rights_outlives_a_file_that_cannot_be_read(tmp_path, caplog):
    """It says so once, and takes up the next change."""
    found = made(tmp_path, {})
    with EmbeddedServer(tmp_path / "u") as server:
        keeper = RightsKeeper(server.url, Identities(tmp_path))
        keeper.apply()
        found.path.rename(tmp_path / "aside")
        found.path.mkdir()
        keeper.start()
        wait_for(lambda: "changes of rights are not taken up" in caplog.text)
        found.path.rmdir()
        made(tmp_path, {"kitsune": Rights(app="kitsune")})
        commands = client(server.url)
        wait_for(lambda: any(b"kitsune" in user for user in commands.execute_command("ACL", "USERS")))
        commands.close()
        keeper.stop()
    assert len(caplog.records) == 1
