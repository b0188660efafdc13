# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gyros and accelerometers in two arrays over real DDS: injector, monitor, and what the monitor publishes."""

import time
from itertools import count

import numpy as np
from bag.recordings import array
from monitor.test_accelerometers import array_flight, array_settings
from ros.harness import listening
from ros.processes import parameter_file, running, wait
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from fdi_ros.core.messages import integrity_labels
from fdi_ros.core.sources import ChannelsSource, ImuSource
from fdi_ros.monitor.output import ChannelState

FAULT = "channel=a3 kind=bias size=8"
NAMES = [*(f"g{k + 1}" for k in range(6)), *(f"a{k + 1}" for k in range(6))]


def test_an_injected_fault_of_an_array_of_accelerometers_is_named(
    tmp_path, compiled
) -> None:
    config = array_settings(
        health__stale_timeout=0.5, health__stuck_time=0.0, imus__timeout=0.5
    )
    file = parameter_file(config, tmp_path)
    remaps = [f"{topic}:={topic}_faulty" for topic in config.topics]
    block, force = array_flight(5000)
    rows = count()
    with (
        listening(config.topics, Float64MultiArray) as listener,
        running("injector_node", file, faults=FAULT) as injector,
        running("fdi_node", file, *remaps) as monitor,
    ):
        assert wait(
            lambda: all(one.get_subscription_count() for one in listener.outputs)
        ), injector.said() + monitor.said()

        def said() -> dict[str, float]:
            """Send a sample, and return what the last integrity message says."""
            k = next(rows) % len(block)
            listener.outputs[1].publish(array(block.acceleration.z[k].tolist()))
            listener.outputs[0].publish(array(block.z[k].tolist()))
            time.sleep(0.01)
            labels = integrity_labels(NAMES, 6)
            if not listener.integrity:
                return dict.fromkeys(labels, np.nan)
            _, values = ChannelsSource.parse(listener.integrity[-1], len(labels))
            return dict(zip(labels, values, strict=True))

        def states() -> set[float]:
            return {value for name, value in said().items() if name[:6] == "state "}

        # An error within the first samples would pass for a bias since the start, also
        # where a busy machine makes a pause before it.
        assert wait(
            lambda: states() == {ChannelState.OK} and len(listener.integrity) > 100
        ), monitor.said()
        _, fused = ImuSource.parse(listener.fused[-1], 6)
        assert np.abs(fused[3:] - force[: next(rows)]).sum(axis=1).min() < 1.5
        assert listener.call(Trigger, "injector_node/start").success
        assert wait(lambda: said()["state a3"] == ChannelState.FAULTY), monitor.said()
        last = said()
        others = [name for name in NAMES if name != "a3"]
        assert ChannelState.FAULTY not in [last[f"state {name}"] for name in others]
        assert listener.says("a3", "isolated", meanwhile=said)
