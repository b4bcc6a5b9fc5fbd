"""Remote: a store on an S3 server, and a scheduler over TLS; on loopback."""

import contextlib
import json
import os
import re
import subprocess
import time
from pathlib import Path

import dask
import pytest

import sweep
from support.clusters import CLIENT, Cluster
from support.commands import command, started
from support.stores import by_hand
from sweep.cli import main
from sweep.errors import StoreError
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import verify
from sweep.store.lifecycle import create_store, open_store, remove_store, reopen
from sweep.store.locations import exists
from sweep.store.lock import is_written, writing

boto3, trustme = map(pytest.importorskip, ("boto3", "trustme"))

TIMEOUT_S = 240.0

SMALL = """
seed = 5
pose = { jitter_px = 0.5, azimuth_deg = { uniform = [0, 360] } }
[axes]
dictionary = ["DICT_4X4_50", "DICT_5X5_50"]
distance_m = { geom = [0.2, 1.5, 4] }
tilt_deg = [0, 50]
solver = ["ippe_square", "iterative"]
trial = 3
"""


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


LOGIN = {"AWS_ACCESS_KEY_ID": "key-of-tests", "AWS_SECRET_ACCESS_KEY": "secret-of-tests"}


def told_in(text):
    """Tell whether a text holds the credentials."""
    return any(value in text for value in LOGIN.values())


def contents(prefix=""):
    """Return the contents of the bucket by key."""
    objects = boto3.resource("s3").Bucket("bucket").objects.filter(Prefix=prefix)
    return {each.key: each.get()["Body"].read() for each in objects}


@pytest.fixture(scope="module")
def bucket(tmp_path_factory):
    """An S3 server with a bucket, which this process's environment leads to."""
    folder = tmp_path_factory.mktemp("s3")
    log = folder / "server.log"
    with log.open("w") as told, started(
        ["-m", "moto.server", "-H", "127.0.0.1", "-p", "0"], stdout=told, stderr=told
    ) as server:
        deadline = time.monotonic() + TIMEOUT_S
        while (found := re.search(r"http://127\.0\.0\.1:\d+", log.read_text())) is None:
            assert server.poll() is None, log.read_text()
            assert time.monotonic() < deadline, "the S3 server does not start"
            time.sleep(0.05)
        url = found[0]
        with pytest.MonkeyPatch.context() as patch:
            for name in [name for name in os.environ if name.startswith("AWS_")]:
                patch.delenv(name)
            for name, value in {
                "AWS_ENDPOINT_URL": url, "AWS_DEFAULT_REGION": "eu-central-1",
                "AWS_CONFIG_FILE": os.devnull, "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
                "AWS_EC2_METADATA_DISABLED": "true", **LOGIN,
            }.items():
                patch.setenv(name, value)
            boto3.setup_default_session()
            boto3.client("s3").create_bucket(
                Bucket="bucket", CreateBucketConfiguration={"LocationConstraint": "eu-central-1"})
            yield


@pytest.mark.system
@pytest.mark.usefixtures("bucket")
def test_server_refuses_changes_while_a_process_writes(monkeypatch):
    monkeypatch.setattr("sweep.store.lock.SILENCE_S", 6.0)  # a key is renewed each second
    url = "s3://bucket/written.zarr"
    pipeline = Pipeline.from_text("axes.trial = 4\n[pose]\njitter_px = 0.5\nside_px = 40")
    store = create_store(url, pipeline, (2,))
    with writing(url, store.storage):
        before = contents("written.zarr/")
        assert any(time.sleep(0.1) or contents("written.zarr/") != before for _ in range(600))
        assert is_written(store.storage)
        for change in (
            lambda: remove_store(url), lambda: reopen(store),
            lambda: execute(pipeline, url, overwrite=True),
        ):
            with pytest.raises(StoreError, match="is writing it"):
                change()
    with pytest.raises(StoreError, match="has made it meanwhile"):
        create_store(url, pipeline, (2,))
    assert open_store(url).run_id == store.run_id
    assert {key.split("/")[1] for key in contents("written.zarr/")} == {
        "zarr.json", store.run_id}
    remove_store(url)
    assert not exists(url)


@pytest.mark.evidence
def test_stores_on_a_real_object_store_are_as_local_ones(claim):
    script = Path(__file__).parents[1] / "object_store.py"
    with started([script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        out, err = running.communicate()
    if out.startswith("not installed"):
        pytest.skip(out.strip())
    assert running.returncode == 0, out + err
    claim("store on OpenStack Swift, its run killed and continued by two clients",
          "a local store", 0.0, "bits differ")


@pytest.mark.parametrize("url", [
    pytest.param("two.zarr", marks=pytest.mark.system),
    pytest.param("s3://bucket/two.zarr", marks=pytest.mark.evidence),
])
def test_two_clients_at_once_leave_one_sound_store_of_the_same_bits(url, small, tmp_path, request):
    if url.startswith("s3:"):
        request.getfixturevalue("bucket")
    else:
        url = str(tmp_path / url)
    create_store(url, Pipeline.from_toml(small), (1, 1, 1, 3))
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(started(["-c", CLIENT, small, url, "", 1.0]))
                   for _ in range(2)]
        assert [client.wait(timeout=TIMEOUT_S) for client in clients] == [0, 0]
    report = verify(url, 0)
    assert (report.finished, report.blocks_done, report.damage) == (True, 16, [])
    by_hand(str(tmp_path / "one.zarr"), Pipeline.from_toml(small))
    alone = sweep.open(tmp_path / "one.zarr").load()
    for name, values in sweep.open(url).load().items():
        assert values.to_numpy().tobytes() == alone[name].to_numpy().tobytes(), name


@pytest.fixture
def tls(tmp_path):
    """Return what makes a cluster's processes use certificates; this process's client, too."""
    authority = trustme.CA()
    issued = authority.issue_cert("127.0.0.1")
    files = [tmp_path / name for name in ("ca.pem", "cert.pem", "key.pem")]
    for content, path in zip(
        (authority.cert_pem, issued.cert_chain_pems[0], issued.private_key_pem), files, strict=True
    ):
        content.write_to_path(path)
    ca, cert, key = map(str, files)
    with dask.config.set({
        "distributed.comm.tls.ca-file": ca,
        "distributed.comm.tls.client.cert": cert, "distributed.comm.tls.client.key": key,
    }):
        yield {"protocol": "tls",
               "options": ("--tls-ca-file", ca, "--tls-cert", cert, "--tls-key", key)}


@pytest.mark.system
@pytest.mark.usefixtures("bucket")
def test_remote_store_of_a_tls_cluster_holds_what_a_local_one_does(tls, small, tmp_path, capfd):
    url = "s3://bucket/all.zarr"
    with Cluster(tmp_path / "cluster", **tls) as cluster:
        cluster.worker()
        assert main(["run", str(small), "--store", url, "--scheduler", cluster.address,
                     "--json"]) == 0
        ran = capfd.readouterr()
        assert ran.err in ("", "starting\n")  # the latter on a busy machine
        assert json.loads(ran.out)["computed_scenes"] == 48
        by_hand(str(tmp_path / "local.zarr"), Pipeline.from_toml(small))
        there, here = (sweep.open(each).load() for each in (url, tmp_path / "local.zarr"))
        assert there.equals(here)
        for name in here.data_vars:
            assert there[name].to_numpy().tobytes() == here[name].to_numpy().tobytes(), name
        assert main(["status", url, "--json"]) == 0
        state = capfd.readouterr()
        assert json.loads(state.out)["finished"]
        told = ran.out + ran.err + state.out + state.err + cluster.log()
    assert "tls://127.0.0.1" in told
    assert not told_in(told)
    for key, content in contents().items():
        assert not told_in(key)
        assert not told_in(content.decode("latin-1")), key


@pytest.mark.system
@pytest.mark.usefixtures("bucket")
def test_server_without_credentials_is_told_in_a_line(small):
    url = "s3://bucket/no.zarr"
    without = {name: value for name, value in os.environ.items() if name not in LOGIN}
    ran = command("run", small, "--store", url, "--workers", "1", env=without)
    assert (ran.returncode, ran.stdout) == (2, ""), ran.stderr
    assert ran.stderr.startswith(f"{url}: cannot be ")
    assert len(ran.stderr.splitlines()) == 1


@pytest.mark.parametrize("url", [
    "s3://AKIDEXAMPLE:wJalrXUtnFEMI@bucket/x.zarr", "s3://bucket/x.zarr?secret=wJalrXUtnFEMI",
    "s3://wJalrXUtnFEMI@bucket/x.zarr",
])
def test_credentials_in_a_store_name_are_refused_and_not_repeated(url, small, tmp_path, capsys):
    for options in (["--store", url], ["--reuse", url, "--store", str(tmp_path / "x.zarr")]):
        assert main(["run", str(small), *options]) == 2
        out, err = capsys.readouterr()
        assert "credentials" in err
        assert len(err.splitlines()) == 1
        assert "wJalrXUtnFEMI" not in out + err
        assert "AKIDEXAMPLE" not in out + err
