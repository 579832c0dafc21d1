"""Ports that nobody has now."""

import socket


def free_ports(count: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, kind) for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    (port,) = free_ports(1, kind)
    return port
