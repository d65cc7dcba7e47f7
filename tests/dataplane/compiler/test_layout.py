"""Which frames may leave as they came, and which metadata is a variable of one pipeline."""

from dataclasses import replace

from dataplane.compiler import layout
from dataplane.v1model.tree import Extract
from tests.dataplane.loading import features, sdnator


def test_frames_leave_as_they_came_but_for_packet_outs():
    assert layout.make(sdnator()).out_of_order == {Extract("packet_out")}


def test_headers_in_another_order_are_put_together_anew():
    program = sdnator()
    names = program.deparser
    swapped = layout.make(replace(program, deparser=(*names[:-2], names[-1], names[-2]))).out_of_order
    assert {names[-1]} <= {op.header for op in swapped} - {"packet_out"}
    twice = layout.make(replace(program, deparser=(*names, "tcp"))).out_of_order
    assert Extract("tcp") in twice


def test_metadata_that_leaves_its_pipeline_is_kept_with_the_packet():
    for program in (sdnator(), features()):
        made = layout.make(program)
        private = {ref for refs in made.private.values() for ref in refs}
        assert private
        assert not private & {ref for refs in program.field_lists.values() for ref in refs}
        digests = {field for spec in program.digests.values() for field in spec.fields}
        assert not private & digests
        assert not {layout.STANDARD} & {
            ref.header for ref in private if ref.field.name in layout.ENGINE_FIELDS
        }
