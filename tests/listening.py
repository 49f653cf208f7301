"""On which addresses a process and its children wait for others."""

import psutil


def listening(pid: int) -> set[tuple[str, int]]:
    """Address and port of every TCP socket that listens."""
    process = psutil.Process(pid)
    return {
        (socket.laddr.ip, socket.laddr.port)
        for one in (process, *process.children(recursive=True))
        for socket in one.net_connections(kind="tcp")
        if socket.status == psutil.CONN_LISTEN
    }
