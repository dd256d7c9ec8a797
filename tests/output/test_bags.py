"""Runs as bags of ROS 2, read back by two libraries; and recordings of others."""

import struct
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from recordings import flown
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

import echelon as ech
from echelon.core.errors import MissingExtraError, OutputError
from echelon.output.archive.bags import body_rates, mcap_content, save_bag

DATA = flown(agents=3, seconds=1.0, rate=20.0)
PLACES = {k: f"/agent{k}/odom" for k in range(3)}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags") / "bag"
    save_bag(DATA, folder)
    return folder


def test_rosbags_reads_the_states_and_inputs_that_were_written(bag):
    states, inputs = np.full_like(DATA.states, np.nan), np.full_like(DATA.inputs, np.nan)
    tables = {"states": states, "inputs": inputs}
    with AnyReader([bag]) as reader:
        for way, stamp, raw in reader.messages():
            agent, topic = way.topic[1:].split("/")
            if topic in tables:
                message = reader.deserialize(raw, way.msgtype)
                [label] = message.layout.dim
                names = DATA.state_names if topic == "states" else DATA.input_names
                assert label.label.split() == [*names] and label.size == len(names)
                row = np.flatnonzero(np.rint(1e9 * DATA.times) == stamp)[0]
                tables[topic][row, int(agent[5:])] = message.data
    assert np.array_equal(states, DATA.states) and np.array_equal(inputs, DATA.inputs)


def test_an_mcap_file_alone_is_read_by_the_library_of_the_format(tmp_path):
    """The last bytes of each message are its doubles."""
    file = tmp_path / "run.mcap"
    file.write_bytes(mcap_content(DATA))
    found = {f"/agent{k}/inputs": [] for k in range(3)}
    places = {f"/agent{k}/pose": [] for k in range(3)}
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert channel.message_encoding == "cdr" and schema.encoding == "ros2msg"
            if channel.topic in found:
                found[channel.topic].append(np.frombuffer(message.data[-32:]))
            if channel.topic in places:
                places[channel.topic].append(np.frombuffer(message.data[-56:-32]))
    assert np.array_equal(np.stack([*found.values()], axis=1), DATA.inputs)
    assert np.array_equal(np.stack([*places.values()], axis=1), DATA.states[:, :, :3])


def test_what_was_written_is_loaded_again(bag):
    found = ech.load(bag, agents=PLACES)
    assert found.state_names == DATA.state_names
    assert found.times == pytest.approx(DATA.times, abs=1e-9)
    assert np.allclose(found.states, DATA.states, rtol=0.0, atol=1e-9)
    poses = ech.load(bag / "bag.mcap", agents={7: "/agent2/pose"})
    assert [*poses.tracks] == [7] and poses.state_names == DATA.state_names[:3] + DATA.state_names[
        6:9
    ]
    assert np.allclose(poses.states[:, 0, :3], DATA.states[:, 2, :3], rtol=0.0, atol=0.0)


def test_tracks_have_times_of_their_own_and_are_put_on_those_of_the_first(bag):
    track = ech.load(bag, agents=PLACES).tracks[1]
    between = 0.5 * (track.times[:-1] + track.times[1:])
    assert np.allclose(track.at(between), 0.5 * (track.states[:-1] + track.states[1:]))
    assert np.isnan(track.at(np.array([-1.0, 2.0]))).all()


def test_rates_of_the_body_are_those_of_its_rotation():
    """R(t)' R(t + h) is a turn by the rates, to second order about the middle."""
    angles, rates, h = np.array([[0.3, -0.5, 2.0]]), np.array([[0.7, -0.4, 1.1]]), 1e-4
    before, after = (
        Rotation.from_euler("ZYX", (angles + sign * 0.5 * h * rates)[:, ::-1]) for sign in (-1, 1)
    )
    turn = (before.inv() * after).as_rotvec() / h
    assert turn == pytest.approx(body_rates(angles, rates), abs=1e-7)


def test_a_topic_that_a_bag_lacks_is_refused_with_those_that_it_has(bag):
    words = "has no topic `/cf1/pose` that can be read; it has `/agent0/inputs` "
    with pytest.raises(OutputError, match=words) as refused:
        ech.load(bag, agents={0: "/cf1/pose"})
    assert "`/agent2/pose` (geometry_msgs/PoseStamped)" in str(refused.value)
    # An array has no place.
    with pytest.raises(OutputError, match="has no topic `/agent0/states` that can be read"):
        ech.load(bag, agents={0: "/agent0/states"})
    with pytest.raises(OutputError, match="`agents` names no topic"):
        ech.load(bag, agents={})


def test_what_is_no_recording_is_one_sentence(tmp_path):
    for name in ("bad.mcap", "bad.ulg", "bad.bin", "folder"):
        (tmp_path / name).write_bytes(b"nothing") if "." in name else (tmp_path / name).mkdir()
        with pytest.raises(OutputError, match=f"{name}` cannot be read as a"):
            ech.load(tmp_path / name, agents={0: "/cf1/pose"})


def test_without_the_library_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(MissingExtraError, match=r"pip install '.\[bags\]'"):
        mcap_content(DATA)


def test_the_command_writes_a_file_and_a_folder(echelon, here):
    assert (
        echelon(
            "run", "integrators", "--set", "simulation.horizon=0.5", "--out", "r", "--no-figures"
        )[0]
        == 0
    )
    assert echelon("export", "r", "--out", "x.mcap")[0] == 0
    assert echelon("export", "r", "--to", "rosbag2", "--out", "bag")[:2] == (
        0,
        "- Written to bag.\n",
    )
    assert (here / "bag" / "metadata.yaml").is_file()
    run, names = ech.load("r"), {0: "/agent0/pose", 1: "/agent1/pose"}
    for place in ("x.mcap", "bag"):
        found = ech.load(place, agents=names)
        assert np.array_equal(found.states[:, :, :2], run.states[:, :2, :2])
    code, _, err = echelon("export", "r", "--to", "rosbag2", "--out", "bag")
    assert (
        code != 0
        and err == "echelon: `bag` exists; choose another name for the folder of the bag.\n"
    )


# ---- logs of autopilots --------------------------------------------------------------------------


def ulog(name, fields, rows):
    """A ULog file, by its published format: a header, a format, a subscription, data."""

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    types = {"Q": "uint64_t", "f": "float", "B": "uint8_t"}
    text = "".join(
        f"{types[code[-1]]}{f'[{code[:-1]}]' if code[:-1] else ''} {field};"
        for field, code in fields.items()
    )
    layout = "<" + "".join(fields.values())
    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    out += message("F", f"{name}:{text}".encode())
    out += message("A", struct.pack("<BH", 0, 3) + name.encode())
    for row in rows:
        out += message("D", struct.pack("<H", 3) + struct.pack(layout, *row))
    return out


def test_a_log_of_px4_has_the_axes_of_echelon(tmp_path):
    """North-facing and nose down by 0.2: its yaw is pi / 2, its pitch 0.2; it flies north."""
    fields = {
        **{"timestamp": "Q", "position": "3f", "q": "4f", "velocity": "3f"},
        **{"angular_velocity": "3f", "velocity_frame": "B"},
    }
    nose_down = [np.cos(0.1), 0.0, -np.sin(0.1), 0.0]
    rows = [
        (1_000_000 * k, 1.0 + k, 2.0, -3.0, *nose_down, 1.0, 0, 0, 0.1, 0.2, 0.3, 1) for k in (1, 2)
    ]
    (tmp_path / "a.ulg").write_bytes(ulog("vehicle_odometry", fields, rows))
    found = ech.load(tmp_path / "a.ulg", agents={0: "vehicle_odometry"})
    wanted = [2.0, 2.0, 3.0, 0.0, 1.0, 0.0, 0.0, 0.2, 0.5 * np.pi, 0.1, -0.2, -0.3]
    order = ["x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "p", "q", "r"]
    assert [*found.state_names] == order and found.times == pytest.approx([1.0, 2.0])
    assert found.states[0, 0] == pytest.approx(wanted, abs=1e-6)
    # Along the nose, which points down: north and down.
    rows = [(*row[:8], 1.0, 0.0, 0.0, *row[11:-1], 3) for row in rows]
    (tmp_path / "b.ulg").write_bytes(ulog("vehicle_odometry", fields, rows))
    speed = ech.load(tmp_path / "b.ulg", agents={0: "vehicle_odometry"}).states[0, 0, 3:6]
    assert speed == pytest.approx([0.0, np.cos(0.2), -np.sin(0.2)], abs=1e-6)
    with pytest.raises(
        OutputError, match="has no topic `pose` that can be read; it has `vehicle_od"
    ):
        ech.load(tmp_path / "b.ulg", agents={0: "pose"})


def test_a_local_position_of_px4_has_a_heading(tmp_path):
    fields = {"timestamp": "Q", **dict.fromkeys(("x", "y", "z", "vx", "vy", "vz", "heading"), "f")}
    rows = [(1_000_000 * k, 1.0, 2.0, -3.0, 0.1, 0.2, -0.3, 3.1 + 0.1 * k) for k in range(3)]
    (tmp_path / "a.ulg").write_bytes(ulog("vehicle_local_position", fields, rows))
    found = ech.load(tmp_path / "a.ulg", agents={0: "vehicle_local_position"})
    assert [*found.state_names] == ["x", "y", "z", "vx", "vy", "vz", "yaw"]
    wanted = [2.0, 1.0, 3.0, 0.2, 0.1, 0.3, 0.5 * np.pi - 3.1]
    assert found.states[0, 0] == pytest.approx(wanted, abs=1e-6)


def test_a_log_of_a_crazyflie_has_seconds_radians_and_its_pitch_negated(tmp_path):
    head = "Timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z,stateEstimate.roll,"
    rows = ["1000,1,2,3,10,-20,170", "1010,1.5,2,3,10,-20,-170"]
    text = "\n".join([f"{head}stateEstimate.pitch,stateEstimate.yaw", *rows])
    (tmp_path / "log.csv").write_text(text + "\n")
    found = ech.load(tmp_path / "log.csv", agents={0: "stateEstimate"})
    assert found.times == pytest.approx([1.0, 1.01])
    assert found.states[0, 0] == pytest.approx([1.0, 2.0, 3.0, *np.radians([10.0, 20.0, 170.0])])
    assert found.states[1, 0, 5] == pytest.approx(np.radians(190.0))
    with pytest.raises(OutputError, match="lacks `x`, `y`"):
        ech.load(tmp_path / "log.csv", agents={0: "kalman"})
