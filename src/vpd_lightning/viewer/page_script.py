"""What we add to viser's page: arrow keys are ours, and do not turn the camera as well."""

import functools
import gzip

from websockets.http11 import Response

# viser's commands listen at the document's element, its camera at the document above: what stops here reaches the
# former alone. WASD and Q, E still move the camera.
_SCRIPT = b"""<script>
document.documentElement.addEventListener("keydown", (event) => {
  if (event.code.startsWith("Arrow")) event.stopPropagation();
});
</script>"""


def add_script(response: Response) -> None:
    """Put our script into a response that is an HTML page; leave all others alone."""
    headers, body = response.headers, response.body
    if body is None or not headers.get("Content-Type", "").startswith("text/html"):
        return
    changed = _with_script(bytes(body), headers.get("Content-Encoding") == "gzip")
    if "Content-Length" in headers:
        del headers["Content-Length"]
        headers["Content-Length"] = str(len(changed))
    response.body = changed


@functools.lru_cache(maxsize=2)
def _with_script(body: bytes, is_gzipped: bool) -> bytes:
    page = gzip.decompress(body) if is_gzipped else body
    page = page.replace(b"<head>", b"<head>" + _SCRIPT, 1)
    return gzip.compress(page) if is_gzipped else page
