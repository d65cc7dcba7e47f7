"""Frames end to end are the frames, for the ports and for both back ends of the switch."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataplane.frame_block import FrameBlock
from dataplane.v1model.switch import Switch
from sdnator.testing.switch_traffic import Chooser, feature_frame
from tests.dataplane.loading import MAKERS, features
from tests.dataplane.test_twins import fill

FRAMES = st.lists(st.tuples(st.integers(0, 1 << 48), st.binary(max_size=60), st.integers(0, 20)), max_size=20)


@given(FRAMES, st.integers(0, 20), st.integers(0, 20))
def test_parts_and_padding(given_frames, first, end):
    """Padding fills each frame to its length on the wire; a part is those frames alone."""
    times = [time for time, _, _ in given_frames]
    lengths = [len(data) + more for _, data, more in given_frames]
    block = FrameBlock.of(times, lengths, [data for _, data, _ in given_frames])
    padded = block.padded()
    assert list(padded.frames()) == [data + bytes(more) for _, data, more in given_frames]
    first, end = min(first, len(times)), min(max(first, end), len(times))
    part = padded.part(first, end)
    assert (part.times_us.tolist(), list(part.frames())) == (
        times[first:end],
        list(padded.frames())[first:end],
    )
    assert list(block.frames()) == [data for _, data, _ in given_frames]


@pytest.mark.parametrize("maker", MAKERS)
def test_a_block_leads_to_what_its_frames_lead_to(maker):
    """Random entries and frames, one of them longer than any that is processed."""
    switches = [Switch(features(), maker=maker) for _ in range(2)]
    fill(Chooser(3), switches)
    data = [*(feature_frame(Random(seed)) for seed in range(60)), bytes(70_000), b""]
    block = FrameBlock.of(range(len(data)), [len(each) for each in data], data)
    many, joined = switches[0].process_many(1, data, range(len(data))), switches[1].process_block(1, block)
    assert (list(joined.outputs), joined.packet_ins) == (list(many.outputs), many.packet_ins)
    assert joined.verdicts == many.verdicts
    assert many.outputs
    assert many.digests
    reported = [(each.name, each.sample) for each in many.digests]
    for name in {name for name, _ in reported}:
        alone = [each.sample for each in joined.digests if each.name == name]
        end_to_end = joined.samples[name].each() if name in joined.samples else alone
        assert end_to_end == [sample for each, sample in reported if each == name]
    assert switches[0].statistics() == switches[1].statistics()
    for switch in switches:
        switch.close()
