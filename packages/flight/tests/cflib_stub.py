"""What links use of cflib 0.1.34, writing packets as it does, with the fake Crazyflie behind it."""

import struct
from types import SimpleNamespace

from fake_crazyflie import Crazyflie, packed


class Commander:
    """Writes packets as cflib 0.1.34 does, for the fake."""

    def __init__(self, fake):
        self.fake, self.now, self.dongle = fake, 0.0, None

    def transmit(self, packet):
        if self.dongle is None or self.dongle.carries(packet, self.now):
            self.fake.answer(packet, self.now)

    def send_setpoint(self, roll, pitch, rate, thrust):
        self.transmit(b"\x3c" + struct.pack("<fffH", roll, -pitch, rate, thrust))

    def send_setpoint_manual(self, roll, pitch, rate, percent, rates):
        thrust = int(10001 + 0.01 * percent * (60000 - 10001))
        data = struct.pack("<BfffHB", 11, roll, -pitch, rate, thrust, rates)
        self.transmit(b"\x7c" + data)

    def send_full_state_setpoint(self, place, speed, acceleration, q, *rates):
        numbers = [int(1000 * number) for number in (*place, *speed, *acceleration)]
        turn = [int(1000 * rate) for rate in rates]
        data = struct.pack("<BhhhhhhhhhIhhh", 6, *numbers, packed(q), *turn)
        self.transmit(b"\x7c" + data)

    def send_position_setpoint(self, *numbers):
        self.transmit(b"\x7c\x07" + struct.pack("<ffff", *numbers))

    def send_stop_setpoint(self):
        self.transmit(b"\x7c\x00")


class Callbacks(list):
    add_callback = list.append


class LogConfig:
    def __init__(self, name, period_in_ms):
        assert period_in_ms == 10
        self.variables, self.data_received_cb = {}, Callbacks()

    def add_variable(self, name, kind):
        self.variables[name] = kind

    def start(self):
        assert sum({"i": 2, "u": 4, "F": 2}[kind[0]] for kind in self.variables.values()) <= 26


class Stub:
    """What the link uses of cflib's `Crazyflie`, with the fake behind it."""

    def __init__(self):
        self.fake, self.configs, self.armed = Crazyflie(), [], []
        self.commander, self.connection_lost = Commander(self.fake), Callbacks()
        self.confirm = Callbacks()
        self.param = SimpleNamespace(
            set_value=self.set_value,
            add_update_callback=lambda group, name, cb: self.confirm.append(cb),
        )
        self.log = SimpleNamespace(add_config=self.configs.append)
        self.supervisor = SimpleNamespace(send_arming_request=self.armed.append)

    def set_value(self, name, value):
        self.fake.parameters[name] = value
        for call in self.confirm:
            call(name, str(value))

    def arrive(self, **values):
        names = self.configs[0].variables
        packet = {name: values.get(name.partition(".")[2], 0) for name in names}
        for call in self.configs[0].data_received_cb:
            call(0, packet | {"stateEstimateZ.quat": 3 << 30}, None)
