"""Several solvers agree on who does what, without configuration."""

from __future__ import annotations

from itertools import combinations

from buddyline.solver_service.sharing import NETWORK, Sharing, Task

PAIRS: list[Task] = [*combinations("abcdefgh", 2)]
TASKS: list[Task] = [*PAIRS, NETWORK]


class SharingTeam:
    """Solvers on a bus on which every name is seen at once."""

    def __init__(self, count: int) -> None:
        self.solvers: list[Sharing] = []
        self.names: dict[str, set[str]] = {}
        for number in range(count):
            self.join(f"{number:016x}")

    def join(self, instance: str) -> Sharing:
        new = Sharing(instance)
        for names in self.names.values():
            for name in names:
                new.saw(name, True)
        self.solvers.append(new)
        self.names[instance] = set()
        self.tell(new, {new.name})
        return new

    def tell(self, one: Sharing, names: set[str]) -> None:
        before, self.names[one.instance] = self.names[one.instance], names
        for other in self.solvers:
            for name in names - before:
                other.saw(name, True)
            for name in before - names:
                other.saw(name, False)

    def tick(self, tasks: list[Task] = TASKS) -> None:
        for one in self.solvers:
            plan = one.plan(tasks)
            names = self.names[one.instance]
            gone = {one.task_name(task) for task in plan.release}
            self.tell(one, (names - gone) | {one.task_name(task) for task in plan.claim})
            doing = [task for other in self.solvers for task in other.begun]
            assert len(doing) == len(set(doing)), "a task is done twice"

    def kill(self, one: Sharing) -> None:
        self.solvers.remove(one)
        self.tell(one, set())

    def done(self) -> set[Task]:
        return {task for one in self.solvers for task in one.begun}


def test_each_task_is_done_by_one_and_all_have_some() -> None:
    team = SharingTeam(3)
    for _ in range(3):
        team.tick()
    assert team.done() == set(TASKS)
    assert all(4 < len(one.begun) < 16 for one in team.solvers)


def test_the_tasks_of_a_killed_one_go_on_within_two_ticks_and_no_other_moves() -> None:
    team = SharingTeam(3)
    for _ in range(3):
        team.tick()
    before = {one.instance: set(one.begun) for one in team.solvers}
    team.kill(team.solvers[1])
    team.tick()
    team.tick()
    assert team.done() == set(TASKS)
    assert all(before[one.instance] <= one.begun for one in team.solvers)


def test_one_that_joins_takes_only_its_share_and_never_before_it_is_let_go() -> None:
    team = SharingTeam(2)
    for _ in range(3):
        team.tick()
    before = {one.instance: set(one.begun) for one in team.solvers}
    new = team.join("00000000000000ff")
    for _ in range(4):
        team.tick()
    assert team.done() == set(TASKS)
    assert all(one.begun <= before[one.instance] for one in team.solvers[:2])
    assert len(new.begun) > 4


def test_two_that_do_not_see_each_other_at_first_do_nothing_twice() -> None:
    one, two = Sharing("a"), Sharing("b")
    task = next(task for task in TASKS if (one.saw(two.name, True), one.owner(task))[1] == "b")
    one.saw(two.name, False)
    assert one.plan([task]).claim == two.plan([task]).claim == [task]
    one.saw(two.name, True)
    one.saw(two.task_name(task), True)
    two.saw(one.name, True)
    two.saw(one.task_name(task), True)
    assert one.plan([task]).release == [task]
    # The name of the other is still there.
    assert two.plan([task]).begin == []
    two.saw(one.task_name(task), False)
    assert two.plan([task]).begin == [task]


def test_a_solver_that_does_not_share_is_noted() -> None:
    one = Sharing("a")
    one.saw("solver/any", True)
    one.saw("node/a", True)
    assert one.strangers == {"solver/any"}
    one.saw("solver/any", False)
    assert not one.strangers


def test_what_another_has_claimed_by_the_hub_is_not_begun_yet() -> None:
    one = Sharing("1" * 16)
    tasks: list[Task] = [("a", "b"), ("a", "c"), NETWORK]
    one.plan(tasks)
    begin = one.plan(tasks).begin
    assert set(begin) == set(tasks)
    other = Sharing("2" * 16)
    assert one.unheld(begin, {other.name, other.task_name(("a", "c")), other.task_name(NETWORK), "node/a"}) == [
        ("a", "b")
    ]
    # It is tried again.
    assert one.begun == {("a", "b")}
    assert one.waits
    assert set(one.plan(tasks).begin) == {("a", "c"), NETWORK}


def test_a_solver_to_which_nothing_is_alive_any_more_was_cut_off() -> None:
    one = Sharing("1" * 16)
    for name in ("node/a", "node/b", "solver/share/" + "2" * 16):
        one.saw(name, True)
    one.saw(one.name, True)
    one.saw("solver/share/" + "2" * 16, False)
    one.saw("node/a", False)
    assert not one.cut_off
    one.saw("node/b", False)
    assert one.cut_off
    one.saw("node/b", True)
    one.let_go()
    assert not one.cut_off
