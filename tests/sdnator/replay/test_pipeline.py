"""A pipeline that is interrupted while it starts lets its users leave before their server goes."""

import pytest
import redis

from sdnator.replay.pipeline import PipelinePlan, ReplayPipeline


def test_users_leave_before_the_parts_are_stopped_also_where_the_start_fails(tmp_path):
    answers = []

    def join(pipeline):
        client = redis.Redis.from_url(pipeline.updates)
        pipeline.before_stop(lambda: answers.append(client.ping()))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), ReplayPipeline(PipelinePlan(folder=tmp_path, first=join)):
        pytest.fail("it has not started")
    assert answers == [True]
