"""Opens connections of every kind to targets on the machine's loopback."""
import json, os, socket
TARGET = json.load(open("target.json"))

def tcp():
    with socket.create_connection(("127.0.0.1", TARGET["tcp"]), timeout=2) as s:
        return s.recv(5)

def udp():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        return s.sendto(b"x", ("127.0.0.1", TARGET["tcp"]))

def unix(name):
    with socket.socket(socket.AF_UNIX) as s:
        s.settimeout(2)
        s.connect(name)
        return s.recv(5)

def listen():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        s.listen()
        return s.getsockname()[1]

def netlink():
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0) as s:
        s.bind((0, 0))
        return True

def attempts():
    yield "TCP to the coordinator's port", tcp
    yield "UDP", udp
    yield "a unix socket by its path", lambda: unix(TARGET["unix"])
    yield "an abstract unix socket", lambda: unix("\0" + TARGET["abstract"])
    yield "listening", listen
    yield "netlink", netlink
    yield "a pair of sockets", lambda: socket.socketpair()
    yield "interfaces", lambda: [n for _, n in socket.if_nameindex() if n != "lo"]
