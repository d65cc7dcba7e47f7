"""Counts the items of each path, in as many processes as are started; every item once, whatever is killed."""

# [totals]
from due import Engine, Item
from due.shard_archive import ArchivedStates
from due.shards import Place


class Totals:
    def __init__(self, engine: Engine) -> None:
        self.saved = ArchivedStates(engine, "house.total.counter")
        self.counts: dict[str, int] = {}

    def load(self, path: str) -> Place | None:
        self.counts[path], place = self.saved.load(path) or (0, None)
        return place

    def save(self, path: str, place: Place) -> None:
        self.saved.save(path, self.counts[path], place)

    def drop(self, path: str) -> None:
        del self.counts[path]

    def take(self, item: Item) -> None:
        self.counts[item.key.partition(":")[0]] += 1


engine = Engine()
engine.init("counter", instances="sharded")
totals = Totals(engine)
engine.keep_state(totals)
engine.observe("house.climate.**").subscribe(totals.take)
# [/totals]

if __name__ == "__main__":
    input("Enter to end\n")
    engine.close()
