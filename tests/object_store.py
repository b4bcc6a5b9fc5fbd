"""A real object store, OpenStack Swift of one node with its S3 interface, and a sweep on it.

    python tests/object_store.py

:data:`INSTALL` installs it (nothing runs or is configured there), and the folder for temporary
files needs extended attributes. The servers are children of this script and end with it.

Swift 2.30 has no writes on a condition (`If-None-Match`), which sweep does not use. It deletes
several keys at once only with a checksum that botocore no longer sends: sweep deletes each alone.
Its listings may lag behind writes if a server is slow: a lock that is not listed is refused.
"""

import contextlib
import os
import pwd
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from unittest import mock

import boto3
from botocore.exceptions import BotoCoreError, ClientError

from sweep.experiment.pipeline import Pipeline
from sweep.store import lock
from sweep.store.blocks import committed
from sweep.store.lifecycle import create_store, remove_store
from sweep.store.locations import exists
from sweep.store.lock import writing

sys.path.insert(0, str(Path(__file__).parent))

from support.commands import command, started
from support.stores import same

INSTALL = "apt-get install swift-account swift-container swift-object swift-proxy memcached"

SERVERS = ("account", "container", "object", "proxy")
PROGRAMS = [f"swift-{server}-server" for server in SERVERS]

# For Swift's own Python: make rings of one disk, or be a server; it ends with its parent.
IN_FOLDER = """
import ctypes, runpy, sys
from swift.common import utils
folder, program, *arguments = sys.argv[1:]
utils.set_swift_dir(folder)
if program == "rings":
    from swift.common.ring import RingBuilder
    for kind, port in zip(("account", "container", "object"), map(int, arguments)):
        ring = RingBuilder(4, 1, 0)
        ring.add_dev({"id": 0, "region": 1, "zone": 1, "weight": 1, "device": "disk",
                      "ip": "127.0.0.1", "port": port})
        ring.rebalance()
        ring.get_ring().save(f"{folder}/{kind}.ring.gz")
else:
    ctypes.CDLL(None).prctl(1, 9)
    sys.argv = [program, *arguments]
    runpy.run_path(program, run_name="__main__")
"""

CONFIGURATION = """
[DEFAULT]
bind_ip = 127.0.0.1
bind_port = {port}
swift_dir = {folder}
devices = {folder}
mount_check = false
workers = 0
user = {user}
container_update_timeout = 60
[pipeline:main]
pipeline = {filters} {server}-server
[app:{server}-server]
use = egg:swift#{server}
account_autocreate = true
[filter:catch_errors]
use = egg:swift#catch_errors
[filter:proxy-logging]
use = egg:swift#proxy_logging
[filter:cache]
use = egg:swift#memcache
memcache_servers = 127.0.0.1:{memcached}
[filter:s3api]
use = egg:swift#s3api
allow_multipart_uploads = false
[filter:tempauth]
use = egg:swift#tempauth
user_sweep_tests = secret .admin
"""

PIPELINE = """
pose = { jitter_px = 0.5, azimuth_deg = { uniform = [0, 360] } }
axes = { side_px = [10, 40], solver = ["ippe_square", "iterative"], trial = 30 }
"""


@contextlib.contextmanager
def object_store(folder):
    """Start the servers in a folder, make a bucket, and yield the environment of clients."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in (*SERVERS, "memcached")]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        *ports, memcached = [each.getsockname()[1] for each in sockets]
    user, url = pwd.getpwuid(os.getuid()).pw_name, f"http://127.0.0.1:{ports[-1]}"
    (folder / "disk").mkdir()
    (folder / "swift.conf").write_text("[swift-hash]\nswift_hash_path_suffix = tests\n")
    programs = [shutil.which(name) for name in PROGRAMS]
    python = Path(programs[0]).read_text(encoding="utf-8").partition("\n")[0].lstrip("#! ")
    swift = [python, "-W", "ignore", "-c", IN_FOLDER, folder]
    subprocess.run([*swift, "rings", *map(str, ports[:-1])], check=True)
    with contextlib.ExitStack() as stack:
        log = stack.enter_context((folder / "log").open("w"))

        def start(*arguments):
            running = stack.enter_context(subprocess.Popen(arguments, stdout=log, stderr=log))
            stack.callback(running.kill)

        start("memcached", "-l", "127.0.0.1", "-p", str(memcached), "-u", user)
        for server, port, program in zip(SERVERS, ports, programs, strict=True):
            file = folder / f"{server}.conf"
            filters = "catch_errors proxy-logging cache s3api tempauth" * (server == "proxy")
            file.write_text(CONFIGURATION.format(
                port=port, folder=folder, user=user, server=server, memcached=memcached,
                filters=filters))
            start(*swift, program, file, "-v")
        key = {"AWS_ACCESS_KEY_ID": "sweep:tests", "AWS_SECRET_ACCESS_KEY": "secret"}
        client = boto3.Session(*key.values()).client("s3", "us-east-1", endpoint_url=url)
        deadline = time.monotonic() + 60
        with contextlib.closing(client):
            while True:
                try:
                    client.create_bucket(Bucket="bucket")
                    break
                except (BotoCoreError, ClientError):  # not all of the servers answer
                    assert time.monotonic() < deadline, (folder / "log").read_text()
                    time.sleep(0.2)
        yield {"AWS_ENDPOINT_URL": url, "AWS_DEFAULT_REGION": "us-east-1", **key}


def sweeps(folder):
    """Run, kill, continue, verify, read and delete a store there; yield a line for each."""
    pipeline, local, url = folder / "small.toml", folder / "local.zarr", "s3://bucket/all.zarr"
    pipeline.write_text(PIPELINE)

    def ends(status, *arguments):
        ran = command(*arguments)
        assert ran.returncode == status, ran.stderr
        return (ran.stdout + ran.stderr).splitlines()[0]

    def client():
        return started(["-m", "sweep", "run", pipeline, "--store", url, "--workers", "1"])

    ends(0, "run", pipeline, "--store", local)
    with mock.patch.dict(os.environ, {"AWS_SECRET_ACCESS_KEY": "wrong"}):
        refused = ends(2, "status", url)
    yield refused
    store = create_store(url, Pipeline.from_toml(pipeline), (1, 3))
    with writing(url, store.storage):
        refused = ends(2, "run", pipeline, "--store", url, "--overwrite")
    assert "another process is writing it" in refused, refused
    yield refused
    with client() as running:
        while not committed(store):
            assert running.poll() is None
            time.sleep(0.05)
    assert len(committed(store)) < len(store.blocks)
    yield f"killed with {len(committed(store))} of {len(store.blocks)} blocks"
    with client() as one, client() as two:
        assert (one.wait(240), two.wait(240)) == (0, 0)
    assert store.finished
    yield ends(0, "verify", url)
    assert same(store.data_url, str(local))
    yield "finished by two clients at once: as a local store, bit for bit"
    lock.SILENCE_S = 3.0  # what the killed process left refuses it for two minutes else
    remove_store(url)
    assert not exists(url)
    yield "deleted"


def main():
    """Print what passes; return 1 if something does not, or programs are missing."""
    if not all(map(shutil.which, ["memcached", *PROGRAMS])):
        print(f"not installed: `{INSTALL}`")
        return 1
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as servers, \
            object_store(Path(servers)) as login:
        os.environ.update(login)
        for line in sweeps(Path(folder)):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
