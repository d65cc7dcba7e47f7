"""What the other apps write is what the controller's decoders take."""

from apps.messages import TableCommand
from apps.p4runtime_ctrl.arrivals import offer_in
from apps.p4runtime_ctrl.telemetry.classifier import Classifier
from apps.p4runtime_ctrl.telemetry.demand import Offers
from due import Item
from due.codec import decode_value, encode_value
from sdnator.testing.product_program import program


def item(key, app, value):
    return Item(key, decode_value(encode_value(value)), 1, 1, app, "i", 1)


def test_offers_and_commands_of_all_queries_are_taken():
    """Every query of the catalogue, as the adapter plans it, passes the limits on messages."""
    from apps.sonata_adapter.control import Control
    from apps.sonata_adapter.query.catalogue import CATALOGUE

    changes = Control(CATALOGUE).want([f"network.traffic_query.sonata.{name}" for name in CATALOGUE])
    classifier = Classifier(program())
    offers = Offers(lambda request: classifier.entries((request,)))
    for value in changes.offer:
        offers.take(*offer_in(item(f"network.telemetry.sonata.{value['name']}", "sonata_adapter", value)))
    assert len(offers) == len(changes.offer)
    command = TableCommand(id="sonata-1", updates=changes.updates).to_value()
    key = "network.p4_command.sonata_adapter.s1"
    assert len(TableCommand.from_item(item(key, "sonata_adapter", command)).updates) == len(changes.updates)
