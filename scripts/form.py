"""The body of an upload, for scripts that have Python's own library alone."""

import uuid


def form(parts: list[tuple[str, str, bytes]]) -> tuple[bytes, str]:
    """A multipart/form-data body of fields, file names and files, and its content type."""
    line = uuid.uuid4().hex
    body = b""
    for field, name, data in parts:
        head = f'--{line}\r\nContent-Disposition: form-data; name="{field}"; filename="{name}"'
        body += head.encode() + b"\r\n\r\n" + data + b"\r\n"
    return body + f"--{line}--\r\n".encode(), f"multipart/form-data; boundary={line}"
