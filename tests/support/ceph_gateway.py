"""Ceph's S3 gateway on this machine, a cluster of one node in memory, and a store on it.

    apt-get install --no-install-recommends ceph-mon ceph-osd radosgw
    python tests/support/ceph_gateway.py

A monitor, a storage daemon and the gateway are started in a temporary folder and ended with it. On
the gateway, a run is killed and continued, compared with a local one, verified, read and deleted;
a deletion beside a writer is refused. A line tells each step.
"""

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path

SETTINGS = """
[global]
fsid = {fsid}
mon host = [v2:127.0.0.1:{mon},v1:127.0.0.1:{mon_v1}]
mon initial members = a
auth cluster required = none
auth service required = none
auth client required = none
ms mon client mode = crc
osd pool default size = 1
osd pool default pg num = 8
osd pool default pg autoscale mode = off
osd crush chooseleaf type = 0
mon allow pool size one = true
mon max pg per osd = 1000
osd objectstore = memstore
memstore device bytes = 4294967296
mon data avail crit = 1
mon data = {folder}/mon
osd data = {folder}/osd
keyring = {folder}/keyring
log file = {folder}/$name.log
admin socket = {folder}/$name.asok
pid file = {folder}/$name.pid
"""
"""One copy of everything, in memory, and nobody asked who he is but by S3's signatures."""

KEY, SECRET, BUCKET = "sweep", "secret-of-a-test", "bucket"

START_S = 120
"""Within which every daemon answers."""


def free_ports(count):
    """Return ports that nobody uses."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


@contextlib.contextmanager
def gateway():
    """Yield the environment by which a process reaches a gateway with an empty bucket."""
    with tempfile.TemporaryDirectory(prefix="ceph-") as name, contextlib.ExitStack() as stack:
        folder, (mon, mon_v1, port) = Path(name), free_ports(3)
        fsid, disk = str(uuid.uuid4()), str(uuid.uuid4())
        (folder / "ceph.conf").write_text(SETTINGS.format(
            fsid=fsid, mon=mon, mon_v1=mon_v1, folder=folder))
        (folder / "keyring").touch()
        (folder / "osd").mkdir()

        def call(*words):
            subprocess.run([words[0], "-c", folder / "ceph.conf", *words[1:]], check=True,
                           stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=START_S)

        def start(*words):
            daemon = subprocess.Popen(
                [words[0], "-c", folder / "ceph.conf", "-f", *words[1:]],
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            stack.callback(daemon.wait)
            stack.callback(daemon.kill)

        subprocess.run(
            ["monmaptool", "--create", "--fsid", fsid, "--addv", "a",
             f"[v2:127.0.0.1:{mon},v1:127.0.0.1:{mon_v1}]", folder / "monmap"],
            check=True, stdout=subprocess.DEVNULL)
        call("ceph-mon", "-i", "a", "--mkfs", "--monmap", folder / "monmap")
        start("ceph-mon", "-i", "a")
        call("ceph", "osd", "new", disk)
        call("ceph-osd", "-i", "0", "--mkfs", "--osd-uuid", disk)
        start("ceph-osd", "-i", "0")
        call("radosgw-admin", "user", "create", "--uid=sweep", "--display-name=sweep",
             f"--access-key={KEY}", f"--secret-key={SECRET}")
        start("radosgw", f"--rgw-frontends=beast endpoint=127.0.0.1:{port}")
        until(lambda: answers(port))
        environment = {
            **os.environ, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "AWS_ACCESS_KEY_ID": KEY, "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_DEFAULT_REGION": "default", "AWS_EC2_METADATA_DISABLED": "true",
            "AWS_CONFIG_FILE": os.devnull, "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
        }
        script = f"import boto3; boto3.client('s3').create_bucket(Bucket={BUCKET!r})"
        subprocess.run([sys.executable, "-c", script], check=True, env=environment)
        yield environment


def answers(port):
    """Return whether somebody listens at a port."""
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def until(condition):
    """Wait until a condition holds; TimeoutError if it does not."""
    end = time.monotonic() + START_S
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(condition)
        time.sleep(0.2)


GRID = """
seed = 3
[pose]
jitter_px = 0.5
[scene]
noise_grey = 1
[axes]
side_px = [20, 30, 40, 60]
solver = ["ippe_square", "iterative"]
trial = 3000
"""

READ = """
import sys
import numpy as np
import sweep
ours, theirs = (sweep.open(url) for url in sys.argv[1:])
for name in theirs.data_vars:
    np.testing.assert_array_equal(ours[name].to_numpy(), theirs[name].to_numpy())
print(len(theirs.data_vars), "variables equal")
"""


def begun(sweep, url, environment):
    """Return whether a store has blocks."""
    ran = subprocess.run([sweep, "status", url, "--json"], env=environment, capture_output=True,
                         text=True, check=False)
    return ran.returncode == 0 and json.loads(ran.stdout)["blocks_done"] > 0


def main():
    """Run, kill, continue, compare, verify, refuse a deletion, delete; on the gateway."""
    sweep = shutil.which("sweep", path=Path(sys.executable).parent)
    url = f"s3://{BUCKET}/grid.zarr"
    with tempfile.TemporaryDirectory() as folder, gateway() as environment:
        pipeline = Path(folder, "grid.toml")
        pipeline.write_text(GRID)

        def command(*words, code=0):
            start = time.perf_counter()
            ran = subprocess.run([sweep, *words], env=environment, capture_output=True, text=True,
                                 check=False)
            last = (ran.stdout + ran.stderr).strip().splitlines()
            print(f"{time.perf_counter() - start:6.1f} s  sweep {' '.join(words)[:60]}: "
                  f"{ran.returncode}: {last[0] if last else ''}", flush=True)
            if ran.returncode != code:
                raise SystemExit(ran.stdout + ran.stderr)
            return ran

        local = f"{folder}/local.zarr"
        command("run", str(pipeline), "--store", local)
        run = [sweep, "run", str(pipeline), "--store", url, "--workers", "2"]
        with subprocess.Popen(run, env=environment, stdout=subprocess.DEVNULL,
                              stderr=subprocess.DEVNULL, start_new_session=True) as first:
            until(lambda: first.poll() is not None or begun(sweep, url, environment))
            command("run", str(pipeline), "--store", url, "--overwrite", code=2)
            os.killpg(first.pid, signal.SIGKILL)
        command("status", url)
        command(*run[1:])
        command("verify", url, "--sample", "20")
        subprocess.run([sys.executable, "-c", READ, url, local], env=environment, check=True)


if __name__ == "__main__":
    main()
