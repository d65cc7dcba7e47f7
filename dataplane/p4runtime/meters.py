"""p4.v1.MeterConfig ↔ MeterConfig of the switch."""

from typing import Any

from dataplane.p4runtime.status import InvalidArgument
from dataplane.v1model.externs import MeterConfig
from p4rt import p4info

_ONE_RATE = (p4info.MeterSpec.SINGLE_RATE_THREE_COLOR, p4info.MeterSpec.SINGLE_RATE_TWO_COLOR)


def meter_config(message: Any, meter_type: int, what: str) -> MeterConfig:
    """A MeterConfig message; rates per second and bursts, in the meter's unit.

    meter_type: MeterSpec.Type of the p4info

    Raises InvalidArgument: negative, PIR below CIR, or fields that the meter's type does not have.
    """
    config = MeterConfig(message.cir, message.cburst, message.pir, message.pburst)
    if min(config.cir, config.cburst, config.pir, config.pburst) < 0:
        raise InvalidArgument(f"meter {what}: rates and bursts cannot be negative")
    if message.eburst:
        raise InvalidArgument(f"meter {what}: this target has no excess burst size")
    if meter_type in _ONE_RATE and (config.pir, config.pburst) != (config.cir, config.cburst):
        raise InvalidArgument(f"meter {what} has one rate: pir and pburst must equal cir and cburst")
    if config.pir < config.cir:
        raise InvalidArgument(f"meter {what}: pir {config.pir} is below cir {config.cir}")
    return config


def write_meter_config(config: MeterConfig, message: Any) -> None:
    """A configuration into a MeterConfig message (which is then set even when all zero)."""
    message.SetInParent()
    message.cir, message.cburst = config.cir, config.cburst
    message.pir, message.pburst = config.pir, config.pburst
