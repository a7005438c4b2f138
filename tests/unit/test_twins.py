"""Companions that hear each other: one acts, the others observe, whoever starts, dies and comes back."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable

import pytest

from nff_companion.autopilots.twins import Rank, Twins, custom_mode
from nff_companion.condition import Mode, Reason
from nff_companion.mavlink.codec import Codec, Message, dialect

STEP_S = 0.1


def heartbeat(instance: int, mode: Mode, rank: Rank, component: int = 191, kind: int = 18) -> Message:
    message = dialect.MAVLink_heartbeat_message(kind, 8, 0, custom_mode(instance, mode, rank), 4, 3)
    (received,) = Codec(1, 194).parse(Codec(1, component).pack(message))
    return received


class Computer:
    """One that runs a companion from ``start_s``; acts in flight whenever nobody is before it."""

    def __init__(self, instance: int, start_s: float, stop_s: float = 1e9, phase_s: float = 0.0) -> None:
        self.twins, self.instance, self.start_s, self.stop_s = Twins(instance), instance, start_s, stop_s
        self.next_s, self.acts, self.able = start_s + phase_s, False, True

    def runs(self, now_s: float) -> bool:
        return self.start_s <= now_s < self.stop_s

    def turn(self, now_s: float, flying: bool) -> list[Message]:
        changed = self.twins.step(now_s, acting=self.acts, able=self.able)
        self.acts = self.able and flying and self.twins.obstacle(now_s, acting=self.acts) is None
        if not changed and now_s < self.next_s:
            return []
        self.next_s = now_s + 1.0
        mode = Mode.ALLOCATE if self.acts else Mode.OBSERVE
        return [heartbeat(self.instance, mode, self.twins.rank)]


def fly(
    computers: list[Computer],
    until_s: float,
    start_s: float = 0.0,
    heard: Callable[[float], bool] = lambda now_s: True,
) -> list[list[int]]:
    """Who acted, at every moment."""
    acted, autopilot = [], heartbeat(0, Mode.OBSERVE, Rank.BYSTANDER, kind=14)
    for k in range(round((until_s - start_s) / STEP_S)):
        now_s = start_s + k * STEP_S
        running = [c for c in computers if c.runs(now_s)]
        for sender in running:
            sender.twins.hear(autopilot, 1, now_s)
            messages = sender.turn(now_s, flying=True)
            for other in running:
                if other is not sender and heard(now_s):
                    for message in messages:
                        other.twins.hear(message, 1, now_s)
        acted.append([c.instance for c in running if c.acts])
    return acted


@pytest.mark.parametrize(("first", "second"), [(10, 20), (20, 10)])
@pytest.mark.parametrize("apart_s", [0.0, 0.5, 1.0, 2.0, 2.5, 3.0, 5.0])
@pytest.mark.parametrize("phase_s", [0.0, 0.4, 0.9])
def test_of_two_that_start_together_or_apart_one_acts_for_good(
    first: int, second: int, apart_s: float, phase_s: float
) -> None:
    acted = fly([Computer(first, 0.0), Computer(second, apart_s, phase_s=phase_s)], 30.0)
    settled = acted[round((apart_s + 4.0) / STEP_S) :]
    assert all(len(who) == 1 for who in settled)
    assert len({who[0] for who in settled}) == 1
    if apart_s >= 3.0:
        assert settled[0] == [first], "the later one observes"


@pytest.mark.parametrize("back_after_s", [0.3, 1.0, 2.9, 3.5, 10.0])
@pytest.mark.parametrize(("acting", "spare", "again"), list(itertools.permutations((10, 20, 30))))
def test_a_spare_or_the_one_that_comes_back_acts_after_a_crash(
    acting: int, spare: int, again: int, back_after_s: float
) -> None:
    a, b = Computer(acting, 0.0, stop_s=20.0), Computer(spare, 5.0)
    acted = fly([a, b, Computer(again, 20.0 + back_after_s)], 60.0)
    assert acted[199] == [acting]
    settled = acted[round(27.0 / STEP_S) if back_after_s < 4 else round((24.0 + back_after_s) / STEP_S) :]
    assert all(len(who) == 1 for who in settled), "never nobody for good, never two"
    gap = [who for who in acted[200:] if not who]
    assert len(gap) * STEP_S < 6.5


def test_the_first_says_that_another_one_is_heard_and_the_later_who_was_first() -> None:
    first, later = Computer(20, 0.0), Computer(10, 5.0)
    fly([first, later], 10.0)
    assert [note.reason for note in first.twins.notes(10.0)] == [Reason.LATER_TWIN]
    assert first.twins.obstacle(10.0, acting=True) is None
    obstacle = later.twins.obstacle(10.0, acting=False)
    assert obstacle is not None
    assert obstacle.reason == Reason.TWIN
    assert later.twins.notes(10.0) == []
    assert first.twins.notes(14.0) == [], "it is gone"


def test_nobody_claims_before_he_has_listened() -> None:
    """Heartbeats come once a second: who claims at once would claim what is another's."""
    twins, ranks = Twins(10), list[Rank]()
    twins.step(0.0, acting=False, able=True)
    ranks.append(twins.rank)  # nothing was heard at all
    for k in range(40):
        twins.hear(heartbeat(0, Mode.OBSERVE, Rank.BYSTANDER, kind=14), 1, 5.0 + 0.1 * k)
        twins.step(5.0 + 0.1 * k, acting=False, able=True)
        ranks.append(twins.rank)
    assert set(ranks[:21]) == {Rank.CANDIDATE}
    assert ranks[-1] == Rank.CLAIMANT


@pytest.mark.parametrize(("first", "second"), [(10, 20), (20, 10)])
def test_two_that_could_not_hear_each_other_agree_once_they_can(first: int, second: int) -> None:
    acted = fly([Computer(first, 0.0), Computer(second, 8.0)], 40.0, heard=lambda now_s: now_s > 20.0)
    assert acted[150] == [first, second], "nobody can know"
    settled = acted[round(22.5 / STEP_S) :]
    assert all(who == [min(first, second)] for who in settled)


def test_one_whose_estimator_fails_gives_up_its_claim() -> None:
    a, b = Computer(10, 0.0), Computer(20, 5.0)
    assert fly([a, b], 10.0)[-1] == [10]
    a.able = False
    assert fly([a, b], 15.0, 10.0)[-1] == [20]
    a.able = True
    assert fly([a, b], 30.0, 15.0)[-1] == [20], "who acts keeps it"


def test_many_that_start_and_die_at_random() -> None:
    seed = random.randrange(2**32)
    print(f"seed {seed}")
    dice = random.Random(seed)
    for _ in range(30):
        computers = [
            Computer(instance, dice.uniform(0, 20), phase_s=dice.uniform(0, 1))
            for instance in dice.sample(range(1, 65536), 4)
        ]
        for computer in dice.sample(computers, 2):
            computer.stop_s = computer.start_s + dice.uniform(1, 20)
        acted = fly(computers, 60.0)
        assert all(len(who) == 1 for who in acted[-100:]), f"seed {seed}"


@pytest.mark.parametrize("rank", list(Rank))
def test_programs_without_a_number_are_no_companions(rank: Rank) -> None:
    """mavros and MAVSDK speak as onboard controllers of the same component."""
    twins = Twins(10)
    for k in range(30):
        twins.hear(heartbeat(0, Mode.OBSERVE, rank), 1, 0.5 + k)
        twins.step(0.5 + k, acting=False, able=True)
        assert twins.obstacle(0.5 + k, acting=False) is None
        assert twins.notes(0.5 + k) == []


def test_one_that_the_operator_lets_observe_stands_in_nobodys_way() -> None:
    twins = Twins(10)
    for k in range(10):
        twins.hear(heartbeat(5, Mode.OBSERVE, Rank.BYSTANDER), 1, float(k))
        twins.step(float(k), acting=False, able=True)
    assert twins.rank == Rank.CLAIMANT
    assert twins.obstacle(9.0, acting=False) is None
