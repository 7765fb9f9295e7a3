"""The logs of a run that is continued hold every step once."""

import pytest

from train.logs import Logs


def rows(tmp_path, name="cost"):
    return (tmp_path / "logs" / "scalars" / f"{name}.csv").read_text().splitlines()


def write(folder, first, last, step=0, tensorboard=False):
    logs = Logs(folder, step, tensorboard)
    for number in range(first, last + 1):
        logs.write(number, {"cost": number / 2} | ({"validation_cost": 0.5} if number % 2 == 0 else {}))
    logs.close()


def test_steps_after_the_last_checkpoint_are_dropped(tmp_path):
    write(tmp_path, 1, 5)  # killed after step 5; its last checkpoint is of step 3
    write(tmp_path, 4, 6, step=3)
    assert rows(tmp_path) == ["1,0.5", "2,1.0", "3,1.5", "4,2.0", "5,2.5", "6,3.0"]
    assert rows(tmp_path, "validation_cost") == ["2,0.5", "4,0.5", "6,0.5"]


def test_a_row_that_was_cut_off_is_dropped(tmp_path):
    write(tmp_path, 1, 3)
    file = tmp_path / "logs" / "scalars" / "cost.csv"
    file.write_text(file.read_text()[:-2])
    write(tmp_path, 3, 3, step=2)
    assert rows(tmp_path) == ["1,0.5", "2,1.0", "3,1.5"]


def test_a_run_that_died_before_its_first_checkpoint_starts_afresh(tmp_path):
    write(tmp_path, 1, 3)
    write(tmp_path, 1, 1)
    assert rows(tmp_path) == ["1,0.5"]
    assert rows(tmp_path, "validation_cost") == []


@pytest.mark.parametrize("content", [b"1,0.5\nx,1.0\n", b"1,0.5\n\xff,1.0\n"])
def test_a_damaged_file_is_named(tmp_path, content):
    write(tmp_path, 1, 1)
    (tmp_path / "logs" / "scalars" / "cost.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"cost\.csv: damaged, move it away to continue the run"):
        write(tmp_path, 3, 3, step=2)


@pytest.mark.slow
def test_tensorboard_shows_every_step_once(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write(tmp_path, 1, 5, tensorboard=True)
    write(tmp_path, 4, 6, step=3, tensorboard=True)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(event.step, event.value) for event in events.Scalars("cost")] == [(n, n / 2) for n in range(1, 7)]
