import logging
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import farm_work
import pytest
import torch

from dsar.errors import ConfigError, MissingDependencyError, RenderError
from dsar_render.farm import cluster_workers, run_tasks, scheduling
from dsar_render.farm.local_workers import ProcessWorkers
from dsar_render.farm.transport import pack

TESTS = Path(farm_work.__file__).parent
COUNT = 12


def _gone(process, seconds):
    """Return whether a process that is not our child ends within some seconds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            state = Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][0]
        except FileNotFoundError:
            return True
        if state == "Z":  # dead; nobody has asked for its exit code yet
            return True
        time.sleep(0.02)
    return False


@pytest.fixture(scope="module")
def cluster():
    """The address of a scheduler on this machine with two workers, which can import the tests' modules."""
    import distributed

    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(path for path in (str(TESTS), *sys.path) if path))
        with distributed.LocalCluster(**options) as local:
            yield local.scheduler_address


@dataclass(frozen=True)
class Course:
    """What happened while two processes worked on tasks, of which one killed its worker the first time."""

    results: list[object]
    ahead: list[int]
    """How many tasks were in flight whenever one was drawn, as far as their traces tell."""
    ended: list[int]
    """The tasks in the order in which they ended."""
    warnings: list[str]


@pytest.fixture(scope="module")
def course(tmp_path_factory):
    folder, ahead, warnings = tmp_path_factory.mktemp("course"), [], []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: warnings.append(record.getMessage())

    def counted():
        for drawn, task in enumerate(farm_work.tasks(folder, COUNT, awaits={4: 5})):
            ahead.append(drawn - len(farm_work.ended(folder)))
            yield task

    scheduling._logger.addHandler(handler)
    try:
        results = list(run_tasks(farm_work.measure_or_die, counted(), jobs=2))
    finally:
        scheduling._logger.removeHandler(handler)
    return Course(results, ahead, farm_work.ended(folder), warnings)


def test_processes_keep_the_order_though_tasks_end_out_of_it(course):
    assert course.results == [(number, 3.0 * number, 1, 1) for number in range(COUNT)]
    assert course.ended.index(5) < course.ended.index(4)


def test_the_next_task_is_drawn_when_fewer_than_two_per_worker_are_in_flight_and_not_before(course):
    assert max(course.ahead) == 3


def test_a_killed_worker_costs_no_result_and_is_told_of(course):
    assert sorted(course.ended) == list(range(COUNT))
    (warning,) = course.warnings
    assert re.fullmatch("render: a worker process died; frames in flight, done again: [1-4]", warning)


def test_a_cluster_gives_the_same_results_as_this_process(cluster, tmp_path):
    large = {"size": 3_000_000}  # more than Dask takes without a warning
    here = list(run_tasks(farm_work.sum_up, farm_work.tasks(tmp_path, 6, **large)))
    there = list(run_tasks(farm_work.sum_up, farm_work.tasks(tmp_path, 6, **large), scheduler=cluster))
    assert there == here == [3e6 * number for number in range(6)]
    with pytest.raises(RenderError, match="Unpicklable: this and that"):
        list(run_tasks(farm_work.write_slowly, farm_work.tasks(tmp_path, 2), scheduler=cluster))


def test_a_worker_that_dies_on_a_cluster_costs_no_result(cluster, tmp_path):
    found = list(run_tasks(farm_work.measure_or_die, farm_work.tasks(tmp_path, 6), scheduler=cluster))
    assert (tmp_path / "killed").exists()
    assert found == [(number, 3.0 * number, 1, 1) for number in range(6)]


@pytest.mark.parametrize(
    "tensor",
    [
        torch.arange(6.0).view(2, 3).T,
        torch.ones(1).expand(4),
        torch.arange(5),
        torch.empty(0, 3),
        torch.tensor(2.5, dtype=torch.float64),
        torch.ones(3, requires_grad=True),
        torch.nn.Parameter(torch.ones(2)),
    ],
    ids=["transposed", "expanded", "integers", "empty", "scalar", "with gradient", "parameter"],
)
def test_tensors_travel_as_they_are(tensor):
    found = pickle.loads(pack({"values": tensor}))["values"]
    assert type(found) is type(tensor)
    same = ((each.dtype, each.shape, each.requires_grad) for each in (found, tensor))
    assert next(same) == next(same)
    assert torch.equal(found, tensor)
    found.detach().add_(1)  # it is its own, and may be written to


def test_one_job_works_beside_the_caller_on_two_tasks_at_most():
    begun, go_on, drawn, ahead = threading.Event(), threading.Event(), [], []

    def work(number):
        begun.set()
        assert go_on.wait(10)
        return threading.get_ident(), number

    def tasks():
        for number in range(6):
            if number == 1:
                assert begun.wait(10)  # the first is in hand while we make the second
                threading.Timer(0.2, lambda: (ahead.append(len(drawn)), go_on.set())).start()
            drawn.append(number)
            yield number

    found = list(run_tasks(work, tasks()))
    assert [number for _, number in found] == drawn == list(range(6))
    assert {thread for thread, _ in found}.isdisjoint({threading.get_ident()})
    assert ahead == [2]


def test_one_job_draws_with_as_many_numeric_threads_as_the_caller():
    import numba

    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        assert list(run_tasks(lambda _: numba.get_num_threads(), [0])) == [1]
    finally:
        numba.set_num_threads(before)


def test_after_an_error_nothing_is_begun_and_what_is_in_hand_is_finished(tmp_path):
    with pytest.raises(RenderError, match="Unpicklable: this and that"):
        list(run_tasks(farm_work.write_slowly, farm_work.tasks(tmp_path, 100), jobs=2))
    # Before the error reaches the caller, the worker that met it may begin another; nobody a third.
    assert {path.name for path in tmp_path.iterdir()} in ({"0.done"}, {"0.done", "2.done"})


def test_an_error_in_one_job_comes_out_as_it_is():
    def work(number):
        if number == 1:
            raise farm_work.Unpicklable("this", "that")
        return number

    with pytest.raises(farm_work.Unpicklable):
        list(run_tasks(work, range(10)))


def test_an_iterator_that_is_closed_or_interrupted_finishes_what_is_in_hand():
    done, drawn, begun = [], [], threading.Event()

    def work(number):
        if number == 100:
            begun.set()
        time.sleep(0.1)
        done.append(number)

    def tasks():
        for number in range(100):
            drawn.append(number)
            yield number

    results = run_tasks(work, tasks())
    next(results)
    results.close()
    assert done in ([0], [0, 1])
    assert len(drawn) <= 3

    def interrupted():
        yield 100
        # Not begun, it would be cancelled.
        assert begun.wait(10)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(run_tasks(work, interrupted()))
    assert done[-1] == 100


def test_a_task_that_kills_three_workers_is_given_up(tmp_path):
    with pytest.raises(RenderError, match=r"died 3 times .* give fewer --jobs"):
        # One worker, because it is their start that takes time.
        list(scheduling.run_in_order(partial(ProcessWorkers, 1), farm_work.die, farm_work.tasks(tmp_path, 1)))
    assert (tmp_path / "deaths").read_text() == "xxx"


def _start(folder, seconds):
    """Start a program that works with two processes; return it and them, when both have a task."""
    path = os.pathsep.join(path for path in sys.path if path)
    command = [sys.executable, farm_work.__file__, str(folder), str(seconds)]
    program = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": path}, start_new_session=True)
    while len(workers := [int(path.stem) for path in folder.glob("*.pid")]) < 2:
        assert program.poll() is None
        time.sleep(0.02)
    return program, workers


def test_workers_end_when_their_parent_is_killed(tmp_path):
    program, workers = _start(tmp_path, seconds=600)
    program.kill()
    program.wait()
    assert all(_gone(worker, seconds=5) for worker in workers)


def test_sigterm_to_the_whole_group_lets_the_tasks_in_hand_be_finished(tmp_path):
    program, workers = _start(tmp_path, seconds=1)
    os.killpg(program.pid, signal.SIGTERM)
    assert program.wait(20) == 143
    assert all(_gone(worker, seconds=5) for worker in workers)
    assert len(list(tmp_path.glob("*.done"))) >= 2


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"jobs": 0}, "--jobs 0: expected .* at least 1"),
        ({"jobs": 2, "scheduler": "tcp://farm:8786"}, "exclude each other"),
    ],
)
def test_flags_that_cannot_be_followed_are_refused_before_any_work(flags, message):
    with pytest.raises(ConfigError, match=message):
        run_tasks(farm_work.sum_up, [], **flags)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "no address at all"])
def test_a_scheduler_that_does_not_answer_is_named(monkeypatch, address):
    monkeypatch.setattr(cluster_workers, "_TIMEOUT_S", 0.5)
    with pytest.raises(ConfigError, match=rf"--scheduler {address}: no Dask scheduler answers"):
        next(run_tasks(farm_work.sum_up, [torch.zeros(1)], scheduler=address))


def test_a_cluster_whose_workers_lack_dsar_is_refused():
    answers = {"tcp://a": None, "tcp://b": ModuleNotFoundError("No module named 'dsar_render'")}
    with pytest.raises(ConfigError, match=r"1 of 2 workers .* install dsar-avatar .*tcp://b: No module"):
        cluster_workers.check_workers("tcp://farm:8786", answers)


def test_without_distributed_a_scheduler_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'dsar-avatar\[farm\]'"):
        run_tasks(farm_work.sum_up, [], scheduler="tcp://farm:8786")
