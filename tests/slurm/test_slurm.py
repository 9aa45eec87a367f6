"""Tests of builds, trainings and sweeps on a real Slurm: a cluster of one machine, started for them on loopback.

    apt-get install slurm-wlm munge
    pytest --full tests/slurm

Takes five to ten minutes: Slurm's shortest time limit is one minute. No services have to run, and root is not needed.
"""

import contextlib
import os
import pwd
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.builds import tree
from support.synthetic import write_synthetic_dataset

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scontrol")
PATH = os.environ["PATH"] + ":/usr/sbin:/sbin"
MISSING = [name for name in PROGRAMS if shutil.which(name, path=PATH) is None]
pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(bool(MISSING), reason=f"needs {', '.join(MISSING)}: apt-get install slurm-wlm munge"),
]

CONFIG = """
ClusterName=loopback
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=15
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
MpiDefault=none
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} State=UNKNOWN
PartitionName=main Nodes={host} Default=YES State=UP
"""
"""A requeued job waits for as long as credentials last, two minutes by default."""


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment in which Slurm's commands speak to a cluster of this machine alone."""
    folder = tmp_path_factory.mktemp("slurm")
    folder.chmod(0o755)
    (folder / "munge.key").write_bytes(os.urandom(1024))
    (folder / "munge.key").chmod(0o600)
    with socket.socket() as one, socket.socket() as two:
        one.bind(("127.0.0.1", 0))
        two.bind(("127.0.0.1", 0))
        ports = (one.getsockname()[1], two.getsockname()[1])
    host = socket.gethostname().partition(".")[0]
    values = {"host": host, "ports": ports, "user": pwd.getpwuid(os.getuid()).pw_name, "folder": folder}
    (folder / "slurm.conf").write_text(CONFIG.format(**values, cpus=os.cpu_count()))
    environment = {**os.environ, "PATH": PATH, "SLURM_CONF": str(folder / "slurm.conf"), "OMP_NUM_THREADS": "1"}
    paths = {"key-file": "key", "socket": "socket", "pid-file": "pid", "seed-file": "seed", "log-file": "log"}
    munged = ["munged", "--foreground", "--force", *(f"--{flag}={folder}/munge.{end}" for flag, end in paths.items())]
    daemons = []
    for words in (munged, ["slurmctld", "-D"], ["slurmd", "-D", "-N", host]):
        with (folder / f"{words[0]}.out").open("wb") as out:
            daemons.append(subprocess.Popen(words, env=environment, stdout=out, stderr=out))
        time.sleep(1)
    try:
        wait_for(lambda: "idle" in shell(environment, "sinfo -h -o %T"))
        yield environment
    finally:
        for daemon in reversed(daemons):
            daemon.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                daemon.wait(30)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working folder with a dataset."""
    write_synthetic_dataset(tmp_path / "data" / "synthetic")
    return tmp_path


def wait_for(is_there: Callable[[], object], within_s: float = 120) -> None:
    start = time.monotonic()
    while not is_there():
        assert time.monotonic() - start < within_s, "waited in vain"
        time.sleep(0.2)


def shell(environment: dict[str, str], line: str) -> str:
    return subprocess.run(line.split(), env=environment, capture_output=True, text=True, check=False).stdout


def start(slurm: dict[str, str], folder: Path, line: str) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", *line.split()]
    return subprocess.Popen(
        words, cwd=folder, env=slurm, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def end(started: subprocess.Popen[str]) -> str:
    """What a command said, once it has ended."""
    out, err = started.communicate(timeout=400)
    print(out, err)
    assert "Traceback" not in err
    return err


ON_SLURM = "--launcher slurm --slurm-cpus 1"
RUN = "synthetic --batch 64 --texture-size 16 --hidden 32"
LONG = f"model train paper {RUN} --steps 900000 {ON_SLURM}"
LONG_RUN = "runs/synthetic/paper-w32-t16-batch64-900000-steps"


def test_a_build_in_jobs_has_the_bytes_of_one_at_once(slurm: dict[str, str], tmp_path: Path) -> None:
    line = "datagen build glass_table --preset tiny --resolution 16 --views 4 --test-views 2 --spp 4 --test-spp 4"
    jobs = start(slurm, tmp_path, f"{line} --out parts {ON_SLURM} --shards 2 --slurm-time 9")
    said = end(jobs)
    assert jobs.returncode == 0 and "part 1/2: done" in said and "part 2/2: done" in said
    whole = start(slurm, tmp_path, f"{line} --out whole")
    end(whole)
    assert tree(tmp_path / "parts") == tree(tmp_path / "whole")


def test_a_sweep_waits_for_what_is_requeued_and_tells_what_was_killed(slurm: dict[str, str], folder: Path) -> None:
    keys = {"dataset": "synthetic", "method": "paper", "batch": 64, "texture-size": 16, "hidden": 32, "steps": 1500}
    block = "".join(f"{key} = {value!r}\n" for key, value in keys.items())
    (folder / "grid.toml").write_text(f"[[runs]]\n{block}seed = [0, 1, 2]\n")
    line = f"model sweep grid.toml {ON_SLURM}"
    name = "paper-w32-t16-batch64-1500-steps"
    sweep = start(slurm, folder, line)
    runs = [folder / "runs" / "synthetic" / f"{name}{suffix}" for suffix in ("", "-seed1", "-seed2")]
    wait_for((runs[0] / "run.json").is_file)
    first, second, _ = sorted(shell(slurm, "squeue -h -r -o %i").split())
    shell(slurm, f"scontrol requeue {first}")
    wait_for((runs[1] / "run.json").is_file)
    shell(slurm, f"scancel {second}")
    wait_for((runs[2] / "run.json").is_file)
    found = shell(slurm, "pgrep -f die_with.*model.cli.*--seed.2").split()
    (child,) = (int(pid) for pid in found if Path(f"/proc/{pid}/cwd").resolve() == folder)
    os.kill(child, signal.SIGKILL)
    said = end(sweep)
    assert sweep.returncode == 1
    assert re.search(rf"--seed 0: requeued by Slurm; will continue when its turn comes \(job {first}\)", said)
    assert re.search(rf"--seed 0: done \(job {first}; ", said)
    assert "sweep grid: 1 of 3 runs are finished" in said
    assert re.search(r"failed: model train .* --seed 1: it was cancelled; log: ", said)
    assert re.search(r"failed: model train .* --seed 2: ended by signal 9; log: ", said)
    assert (runs[0] / "predictions.json").is_file()

    again = start(slurm, folder, line)
    assert "sweep grid: 1 runs were finished before" in end(again) and again.returncode == 0
    by_hand = start(slurm, folder, f"model train paper {RUN} --steps 1500 --seed 1 --out byhand --label {name}-seed1")
    end(by_hand)
    assert tree(runs[1]) == tree(folder / "byhand")


def test_a_job_over_its_limit_says_so_and_resumes(slurm: dict[str, str], folder: Path) -> None:
    over = start(slurm, folder, f"{LONG} --slurm-time 1")
    said = end(over)
    assert over.returncode == 1
    limit = "900000: it reached its time limit (--slurm-time 1); what it finished is kept; log: "
    assert limit in said and said.count("time limit") == 1
    log = Path(re.findall(r"; log: (\S+)", said)[0]).read_text()
    assert "stopped after step" in log

    on = start(slurm, folder, LONG)
    resumed = re.compile(r"resuming after step [\d,]{3,} of 900,000")
    logs = folder / "runs" / "jobs"
    wait_for(lambda: any(resumed.search(path.read_text()) for path in logs.glob("*.err")))
    on.send_signal(signal.SIGINT)  # Ctrl-C cancels the job, which saves its work.
    end(on)
    assert on.returncode == 130
    wait_for(lambda: not shell(slurm, "squeue -h"))
    assert (folder / LONG_RUN / "checkpoint.pt").is_file()


def test_what_slurm_refuses_is_one_line(slurm: dict[str, str], folder: Path) -> None:
    refused = start(slurm, folder, f"{LONG} --slurm-partition none")
    said = end(refused)
    assert refused.returncode == 1
    assert said.splitlines()[-1].startswith("error: --launcher slurm: the cluster took no job (")
    assert "invalid partition specified: none" in said.splitlines()[-1]
