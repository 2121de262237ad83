"""`iris-session web ADDRESS`: a page for browsers on this machine, for a session on this one or another."""

from __future__ import annotations

import argparse

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_address_options,
    add_command,
    add_page_options,
    check_session_reachable,
    parse_port,
    print_error,
)
from iris_session.system.extras import require_package

CONNECT_S = 15.0


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "web",
        run,
        has_json=False,
        help="serve the page for browsers for a session on another machine",
        description="Serve the page for browsers, and the gateway behind it, for a session on another machine. A "
        "session of this machine does so by itself. At an encrypted session the key of this user must be allowed in "
        "role gateway, and in the roles of those who join here: `iris-session pair --role any` there.",
        examples="""
            iris-session web 192.168.0.10
            iris-session web 192.168.0.10:7721 --code 7KQ2-M4XD-9PTR    the first time
            iris-session web 192.168.0.10 --host 127.0.0.1              for browsers of this machine only
        """,
    )
    add_address_options(parser)
    text = "address to listen on (default: all addresses; 127.0.0.1 if the session is not encrypted)"
    parser.add_argument("--host", metavar="ADDR", help=text)
    add_page_options(parser, parse_port)


def run(arguments: argparse.Namespace) -> int:
    """Serve until Ctrl-C. Exit status 1 if the session does not admit the gateway."""
    import asyncio

    for package in ("aiohttp", "cryptography"):
        require_package(package, "the page for browsers")
    from iris_session.client.endpoint_resolver import parse_connect_request, resolve_blocking
    from iris_session.link.interfaces import interfaces, reachable
    from iris_session.security import KeyHome
    from iris_session.web.certificate import load_certificate, load_or_make_certificate
    from iris_session.web.config import WEB_PORT, GatewayConfig, GatewayStart, format_page_address
    from iris_session.web.gateway import serve
    from iris_session.web.page import describe_missing_page

    if bool(arguments.web_cert) != bool(arguments.web_key):
        raise CommandError("--web-cert and --web-key belong together: give both, or none")
    check_session_reachable(arguments)
    request = parse_connect_request(arguments.address, arguments.session, None, arguments.code)
    endpoint = resolve_blocking(request, CONNECT_S)
    curve = endpoint.curve
    host = _choose_host(arguments.host, encrypted=curve is not None)
    found = [one.address for one in reachable((host,), interfaces()) if not one.loopback]
    hosts = tuple(dict.fromkeys(found)) or (host,)  # by which browsers reach the page, best first
    certificate = None
    if arguments.web_cert:
        certificate = load_certificate(arguments.web_cert, arguments.web_key)
    elif curve is not None:
        certificate = load_or_make_certificate(KeyHome(), hosts)
    config = GatewayConfig(
        host=endpoint.address.host,
        control_port=endpoint.address.port,
        server_key="" if curve is None else curve.server_public.decode(),
        public_key="" if curve is None else curve.public.decode(),
        secret_key="" if curve is None else curve.secret.decode(),
        hosts=(host,),
        port=WEB_PORT if arguments.web_port is None else arguments.web_port,
        certificate_path="" if certificate is None else str(certificate.certificate_path),
        key_path="" if certificate is None else str(certificate.key_path),
        certificate_hash=b"" if certificate is None else certificate.spki_hash,
        names=(*hosts, *(() if certificate is None else certificate.names)),
        session_name=endpoint.session,
    )
    pages = [format_page_address(one, config.port, secure=certificate is not None) for one in hosts]
    print(f"in a browser: {'  or  '.join(pages)}{describe_missing_page()}", flush=True)
    if certificate is not None:
        print(f"certificate {certificate.fingerprint}", flush=True)
    endpoint.store_key()
    fault = asyncio.run(serve(GatewayStart(config)))
    if fault:
        print_error(fault)
    return 1 if fault else 0


def _choose_host(host: str | None, *, encrypted: bool) -> str:
    """Return the address to listen on. A session without keys admits everybody, so its page stays on this machine."""
    from iris_session.link.config import is_loopback

    if host is None:
        return "0.0.0.0" if encrypted else "127.0.0.1"
    if not encrypted and not is_loopback(host):
        raise CommandError(
            f"--host {host}: the session is not encrypted and admits everybody who reaches the page: "
            "start it with `iris-session serve --curve`, or leave --host out"
        )
    return host
