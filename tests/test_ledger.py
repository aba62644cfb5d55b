"""Pass numbers are rendered and counted once each, whatever happens to what carries them."""

import random

import pytest
from aniso_pm.distributed.ledger import Ledger
from aniso_pm.distributed.pace import Pace
from aniso_pm.rendering.state import numbers
from hypothesis import given
from hypothesis import strategies as st


def test_what_is_given_back_is_taken_again_first():
    ledger = Ledger(8, 10, [[8, 10], [11, 12]])
    assert ledger.left == 7
    assert ledger.take("a", 3) == [[10, 11], [12, 14]]
    assert ledger.take("b", 2) == [[14, 16]]
    ledger.give_back("a")
    assert ledger.take("c", 4) == [[10, 11], [12, 14], [16, 17]]
    assert ledger.unite("d", ["c", "b"]) == [[10, 11], [12, 17]]
    assert not ledger.finished and ledger.count("d")
    assert ledger.counted == [[8, 17]]
    assert ledger.take("e", 9) == [[17, 18]] and ledger.take("f", 9) == []
    assert ledger.count("e") and ledger.finished


def test_a_late_result_is_dropped():
    ledger = Ledger(0, 4, [])
    ledger.take("slow", 4)
    ledger.give_back("slow")
    ledger.take("fast", 4)
    assert ledger.count("fast")
    assert not ledger.count("slow") and not ledger.count("fast")
    assert ledger.counted == [[0, 4]]


@given(st.integers(0, 2**32), st.integers(1, 40), st.integers(0, 5), st.booleans())
def test_every_pass_is_counted_exactly_once(seed, count, first, endless):
    chance = random.Random(seed)
    done = [[first + 2, first + 3]] if count > 3 else []
    ledger = Ledger(first, 0 if endless else count, done)
    counted = list(numbers(done))
    carriers = {}
    for number in range(300):
        event = chance.random()
        if event < 0.4:
            passes = ledger.take(number, chance.randint(1, 5))
            if passes:
                carriers[number] = list(numbers(passes))
        elif carriers and event < 0.55:
            lost = chance.choice(list(carriers))
            del carriers[lost]
            ledger.give_back(lost)
            assert not ledger.count(lost)
        elif len(carriers) > 1 and event < 0.75:
            a, b = chance.sample(list(carriers), 2)
            carriers[number] = carriers.pop(a) + carriers.pop(b)
            assert list(numbers(ledger.unite(number, [a, b]))) == sorted(carriers[number])
        elif carriers:
            arrived = chance.choice(list(carriers))
            counted += carriers.pop(arrived)
            assert ledger.count(arrived)
    assert sorted(counted) == list(numbers(ledger.counted))
    assert len(set(counted)) == len(counted)
    while not endless and not ledger.finished:  # nothing is lost
        ledger.take("rest", 7)
        for carrier in list(ledger.carried):
            ledger.count(carrier)
    assert endless or ledger.counted == [[first, first + count]]


def test_tasks_take_seconds_and_end_together():
    pace = Pace(task_seconds=5.0, task_limit=None)
    assert pace.passes(100, 4) == 1 and pace.passes(0, 4) == 0
    pace.seen(30.0, 1, first=True)  # with all that happens for the first time
    assert pace.limit(1) == 600
    for _ in range(3):
        pace.seen(2.0, 4, first=False)
    assert pace.each == 0.5
    assert pace.passes(float("inf"), 4) == 10
    assert [pace.passes(left, 4) for left in (1000, 40, 8, 3, 1, 0)] == [10, 5, 1, 1, 1, 0]
    assert [pace.passes(float("inf"), 4, s) for s in (2.0, 0.3, 0.2, -1.0)] == [4, 1, 0, 0]


def test_a_task_has_ten_times_its_time_and_less_where_others_are_idle():
    pace = Pace(5.0, None)
    pace.seen(80.0, 10, first=False)
    assert pace.limit(1) == 300 and pace.limit(10) == 800
    assert pace.limit(1, idle=True) == 60 and pace.limit(10, idle=True) == 240
    pace.too_long()
    assert pace.limit(1) == 600
    assert Pace(5.0, 33.0).limit(10) == 33


@pytest.mark.parametrize("name", ["task_seconds", "task_limit", "patience", "home_every"])
def test_options_out_of_range_are_refused_by_name(name):
    from aniso_pm.distributed import Options

    with pytest.raises(ValueError, match=f"{name} is -1"):
        Options(**{name: -1})
