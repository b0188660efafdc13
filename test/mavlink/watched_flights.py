# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Random flights of failover with its evidence: `cd test && python -m mavlink.watched_flights 200`,
or some of them: `python -m mavlink.watched_flights 400 600`.

Three gyros measure a random motion, and fail at random. In every second flight two of them lose
similar parts of their scale in turn, in the last four of eight they read about twice the rate.
In the last two of four, the node is started anew. The
monitor judges what the gyros send; `Evidence` and the policy judge both, and the vehicle obeys
at once. Every order, and every moment without one, is checked against the true errors of the
gyros. `mavlink.flights` has the link, the autopilot and other stations.
"""

from collections import Counter
from pathlib import Path

import numpy as np

from fdi_ros.config.config import Config
from fdi_ros.mavlink.failover.evidence import Evidence
from fdi_ros.mavlink.failover.policy import PolicySettings, PolicyState, View, decide
from fdi_ros.mavlink.failover.ready import Facts, not_ready
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from mavlink.flights import fly_all

CONFIG = Path(__file__).parents[2] / "config" / "ardupilot.yaml"
MS = 1_000_000
NS = 1000 * MS
START = 1000 * NS
#: Between two samples of each gyro, ns. The monitor gets every second one.
INTERVAL = 9 * MS
TURN = 4  #: Samples between two turns of failover.
ARMED_AT = 12.0  #: s, after gentle motion.
CALM_FOR = 10.0  #: Time without a new fault at the end of a flight, s.
AVERAGED = 13  #: Samples over which a true error is averaged, as failover does.
SEEN = 222  #: Samples in which an IMU that is taken out had its error: 2 s.
RECENT = 55  #: Samples in which those that stay in use had theirs.
SETTINGS = PolicySettings()
BAD = 0.1  #: True error of an IMU that must go out, or that the words must tell of, rad/s.
HEALTHY = 0.01  #: True error of one that may stay alone, rad/s.
#: An IMU that is so bad beside healthy ones is out after this time, s, or failover is not ready.
ANSWERED = 3.0
FACTS = Facts(age=0.02, lost=0.0, trip=10 * MS, obeys=(True,) * 3)


def motion(random: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Return the rates of a vehicle: gentle until it is armed, then one of four ways."""
    phase = random.uniform(0.0, 6.0, 3)
    gentle = [0.5, 0.4, 0.3] * np.sin(np.outer(t, [0.8, 1.1, 0.5]) + phase)
    calm = [0.015, 0.015, 0.008] * np.sin(np.outer(t, [3.0, 2.3, 1.1]) + phase)
    after = {
        "calm": calm,
        "gentle": gentle,
        "circle": calm + np.array([0.05, 0.0, 0.4]),
        "agile": 3.0
        * np.clip(np.sin(np.outer(t, [0.9, 1.3, 0.6]) + phase) ** 7, -0.5, 0.5),
    }
    chosen = after[str(random.choice(list(after)))]
    share = np.clip(t - ARMED_AT, 0.0, 1.0)[:, None]
    rates: np.ndarray = (1.0 - share) * gentle + share * chosen
    return rates


def fail(random: np.random.Generator, t: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the rates of a gyro that fails once at some time."""
    begin = random.uniform(ARMED_AT + 2.0, t[-1] - CALM_FOR)
    end = begin + float(
        random.choice([random.uniform(0.2, 2.0), random.uniform(3.0, 20.0)])
    )
    fails = (begin <= t) & (t < end)
    axes = random.permutation(3)[: random.choice([1, 1, 3])]
    size = random.choice([-1.0, 1.0]) * np.exp(
        random.uniform(np.log(0.05), np.log(1.5), 3)
    )
    since = np.maximum(0.0, t - begin)[:, None]
    kinds = {
        "bias": rates + size,
        "ramp": rates + np.sign(size) * np.minimum(abs(size), 0.1 * since),
        "harmless": rates + 0.02 * np.sign(size),
        "dead": 0.0 * rates,
        "scale": 0.5 * rates,
        "stuck": np.broadcast_to(rates[np.argmax(fails)], rates.shape),
    }
    kind = str(random.choice(["bias", *kinds]))
    if kind == "harmless":
        fails = begin <= t
    failed = rates.copy()
    failed[np.ix_(fails, axes)] = kinds[kind][np.ix_(fails, axes)]
    return failed


def lose_scale(
    random: np.random.Generator, t: np.ndarray, gyros: np.ndarray, more: float
) -> None:
    """Let two gyros lose similar parts of their scale on one axis, one some seconds after the other.

    more: added to both scales. From 1.5 on they read about twice the rate.
    """
    first, second = random.permutation(3)[:2]
    axis = random.integers(3)
    begin = random.uniform(ARMED_AT + 3.0, ARMED_AT + 7.0)
    share = random.uniform(0.4, 0.8) + more
    gyros[t >= begin, first, axis] *= share
    begin += random.uniform(3.0, 8.0)
    gyros[t >= begin, second, axis] *= share + random.uniform(-0.1, 0.1)


def averaged(values: np.ndarray) -> np.ndarray:
    """Return the mean of the last `AVERAGED` values at each time."""
    sums = np.cumsum(np.insert(values, 0, 0.0, axis=0), axis=0)
    first = np.maximum(0, np.arange(len(values)) + 1 - AVERAGED)
    means: np.ndarray = (sums[1:] - sums[first]) / AVERAGED
    return means


class WatchedFlight:
    """One flight: the samples, the true errors, and the checks.

    are_similar: two gyros lose similar parts of their scale, instead of random faults. more: added
    to both scales. is_anew: the node is started anew in flight.
    """

    def __init__(
        self,
        seed: int,
        seconds: float = 60.0,
        are_similar: bool = False,
        is_anew: bool = False,
        more: float = 0.0,
    ) -> None:
        self.random = random = np.random.default_rng(seed)
        self.t = t = np.arange(0.0, seconds, INTERVAL / NS)
        truth = motion(random, t)
        gyros = np.repeat(truth[:, None], 3, axis=1)
        if are_similar:
            lose_scale(random, t, gyros, more)
        for _ in range(0 if are_similar else random.integers(1, 5)):
            k = random.integers(3)
            gyros[:, k] = fail(random, t, gyros[:, k])
        #: Size of the mean error of each IMU, rad/s.
        self.errors = abs(averaged(gyros - truth[:, None])).max(axis=2)
        noisy = gyros + random.normal(0.0, 0.002, gyros.shape)
        repeats = (gyros[1:] == gyros[:-1]).all(axis=2) & (truth[1:] != truth[:-1]).any(
            axis=1
        )[:, None]
        for i, k in zip(*np.nonzero(repeats), strict=True):
            noisy[i + 1, k] = noisy[i, k]
        self.values = np.trunc(1000.0 * noisy) / 1000.0
        self.stamps = START + INTERVAL * np.arange(len(t))
        self.states = self.judge()
        self.late = int(
            random.integers(1, 10)
        )  # age of the monitor's states, in samples
        #: Sample at which the node is started anew.
        self.anew_at = random.integers(len(t) // 3, len(t)) if is_anew else len(t)
        self.use = [True] * 3
        self.evidence = Evidence(3, INTERVAL, SETTINGS.min_size)
        self.state = PolicyState.begin(3)
        self.unanswered = [0] * 3  # turns
        self.done = Counter[str]()

    def judge(self) -> np.ndarray:
        """Return the monitor's states of all channels, one row for each of its samples."""
        pipeline = Pipeline.from_config(Config.from_file(CONFIG))
        values = self.values[::2].reshape(-1, 9)
        output = pipeline.process(
            Block(self.stamps[::2], values, np.ones(values.shape, dtype=bool))
        )
        states: np.ndarray = output.state[:, :9]
        return states

    def start_anew(self) -> None:
        """Start the node anew. It knows what its file has."""
        memories = self.state.memories
        out = [k for k, memory in enumerate(memories) if memory.ours]
        bad = {k: self.evidence.bad(k) for k in out}
        self.evidence = Evidence(3, INTERVAL, SETTINGS.min_size)
        self.evidence.remember(bad)
        self.state = PolicyState.begin(3, out)

    def turn(self, i: int) -> None:
        """Let failover look and act at sample i."""
        now = int(self.stamps[i])
        self.evidence.hear(self.states[max(0, i - self.late) // 2].tolist(), now)
        memories = self.state.memories
        out = [k for k, memory in enumerate(memories) if memory.ours]
        taken = [k for k, memory in enumerate(memories) if memory.taken]
        imus = self.evidence.look([True] * 3, out, now, taken)
        view = View(
            tuple(
                imu._replace(use=use, heard=now)
                for imu, use in zip(imus, self.use, strict=True)
            ),
            linked=True,
            armed=self.t[i] >= ARMED_AT,
            monitored=True,
        )
        decision = decide(self.state, view, now, SETTINGS)
        self.state = decision.state
        memories = self.state.memories
        for order in decision.orders:
            if order.use != self.use[order.imu]:
                self.done["in use" if order.use else "out of use"] += 1
                self.use[order.imu] = order.use
                self.check_order(*order, i)
        self.check_answers(not_ready(memories, view, FACTS, now, SETTINGS), i)

    def check_order(self, imu: int, use: bool, i: int) -> None:
        """Check an order that was just obeyed, at sample i."""
        assert any(self.use), "the last one, by our hand"
        if use:
            return
        error = self.errors[i - SEEN : i + 1, imu].max()
        lately = self.errors[i - RECENT : i + 1].max(axis=0)
        left = min(lately[k] for k in range(3) if self.use[k])
        text = (
            f"IMU {imu + 1} at {self.t[i]:.2f} s, {error:.3f} beside {left:.3f} rad/s"
        )
        assert error >= SETTINGS.min_size / 2, f"a healthy one: {text}"
        assert left <= error, f"a worse one is left: {text}"

    def check_answers(self, why: str, i: int) -> None:
        """Check that a bad IMU in use is answered, or told of."""
        lately = self.errors[max(0, i - TURN) : i + 1]
        for k in range(3):
            rest = [j for j in range(3) if j != k and self.use[j]]
            is_bad = self.use[k] and lately[:, k].min() >= BAD
            fine = [j for j in rest if lately[:, j].max() < HEALTHY]
            is_open = is_bad and self.t[i] > ARMED_AT and len(fine) == len(rest) > 0
            self.unanswered[k] = self.unanswered[k] + 1 if is_open else 0
            lasts = self.unanswered[k] * TURN * INTERVAL >= ANSWERED * NS
            if (
                lasts
                and self.unanswered[k] * TURN * INTERVAL
                < ANSWERED * NS + TURN * INTERVAL
            ):
                self.done["late, told" if why else "late"] += 1
            assert why or not lasts, (
                f"IMU {k + 1} is bad at {self.t[i]:.2f} s, and failover is ready"
            )

    def fly(self) -> Counter[str]:
        """Fly, and return what was done."""
        for i, stamp in enumerate(self.stamps.tolist()):
            if i == self.anew_at:
                self.start_anew()
            for k, (x, y, z) in enumerate(self.values[i].tolist()):
                self.evidence.raw.feed(k, stamp, (x, y, z))
            if not i % TURN:
                self.turn(i)
        return self.done


def begin(seed: int) -> WatchedFlight:
    """Return a flight of the kind that belongs to its number."""
    return WatchedFlight(
        seed,
        are_similar=seed % 2 == 1,
        is_anew=seed % 4 >= 2,
        more=1.5 if seed % 8 >= 4 else 0.0,
    )


if __name__ == "__main__":
    fly_all(begin)
