"""The embedded cluster: on the loopback interface alone, and quiet."""

import socket

import psutil

from sweep.execution.cluster import embedded


def test_embedded_cluster_listens_on_loopback_only_and_needs_no_certain_port(capfd):
    # Dask's usual port for its page is taken, as by another run.
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            taken.bind(("127.0.0.1", 8787))
            taken.listen()
        except OSError:
            pass  # by someone else, which is as good
        with embedded(1) as client:
            me = psutil.Process()
            addresses = {
                connection.laddr.ip
                for process in (me, *me.children(recursive=True))
                for connection in process.net_connections(kind="inet")
                if connection.status == psutil.CONN_LISTEN
            }
            assert client.submit(sum, [1, 2]).result() == 3
    assert addresses == {"127.0.0.1"}
    told = capfd.readouterr()
    assert told.out == told.err == ""
