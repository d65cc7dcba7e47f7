"""A reader's place is held by its lease, and the lease ends with the reader."""

from due.drivers.redis_reader import StreamReader
from due.drivers.redis_streams import readers_name
from due.drivers.redis_wire import client

PATH = "r.lease"


def test_a_lease_is_not_renewed_after_it_was_given_up(server):
    """The keeper's thread renews leases, and ends after the reader."""
    commands = client(server.url)
    for give_up in (StreamReader.close, lambda reader: reader.leave(lambda _path: False)):
        reader = StreamReader(server.url, commands, "group", "one", shared=False)
        reader.add(PATH, "0")
        assert commands.hgetall(readers_name(PATH))[b"group/one"] != b"0"
        give_up(reader)
        reader.renew()
        assert commands.hgetall(readers_name(PATH)) == {b"group/one": b"0"}
    commands.close()
