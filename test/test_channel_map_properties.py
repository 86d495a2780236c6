"""Whatever a channel map says: each channel on its topic once, or one line that names it."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy")

from eha_monitor.errors import InputError
from eha_monitor.ros.topics import UNUSED, topics_of
from eha_monitor.settings import settings_from_tree
from eha_monitor.settings.monitor import CHANNELS

TOPICS = st.one_of(st.sampled_from(["joint_states", "/a/b", "command", ""]),
                   st.text(max_size=6))
FIELDS = st.one_of(st.sampled_from(["position", "velocity", "data", "wrench.force.x", "a[1].b",
                                    "a..b", "", "a[", "data[-1]"]), st.text(max_size=6))
CHANNEL = st.fixed_dictionaries(
    {"topic": TOPICS, "field": FIELDS, "name": st.sampled_from(["", "piston", "pump", "a b"])},
    optional={"delay": st.floats(-1, 1), "scale": st.floats(0.1, 10), "offset": st.floats(-1, 1)})
MAPS = st.dictionaries(st.sampled_from(sorted(CHANNELS)), CHANNEL, max_size=5)


@settings(max_examples=300)
@given(channels=MAPS)
def test_each_channel_stands_on_its_topic_once(channels):
    config = settings_from_tree({"channels": channels}, "rig.yaml")
    try:
        topics = topics_of(config, "rig.yaml")
    except InputError as problem:
        text = str(problem)
        assert "\n" not in text and text.startswith("rig.yaml: channels."), text
        named = text.split("channels.")[1].split(".")[0]
        assert named in channels  # a default is never at fault
        return
    assert len({topic.name for topic in topics}) == len(topics)
    found = [(name, topic.name, entry.name, entry.delay_ns, channel)
             for topic in topics for entry in topic.entries for name, channel in entry.channels]
    assert sorted(name for name, *_ in found) == sorted(set(config.channels) - UNUSED)
    for name, topic, entry, delay_ns, channel in found:
        wanted = config.channels[name]
        assert channel == wanted
        assert (topic, entry) == (wanted.topic, wanted.name)
        assert delay_ns == round(wanted.delay * 1e9)
    names = [entry.source.channels for topic in topics for entry in topic.entries]
    assert sum("x" in each for each in names) == 1  # the position stamps the rows


def test_of_another_entry_than_the_defaults_nothing_else_is_assumed():
    config = settings_from_tree({"channels": {"x": {"name": "arm"}, "force": {"scale": 2.0}}},
                                "rig.yaml")
    assert "v" not in config.channels and config.channels["force"].name == "piston"
    usual = settings_from_tree({"channels": {"x": {"scale": 2.0}}}, "rig.yaml")
    assert {"v", "force"} <= usual.channels.keys()
