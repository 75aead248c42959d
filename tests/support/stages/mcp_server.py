"""A server of the Model Context Protocol on stdin and stdout: its one tool reads the file beside it, and tries to
change it."""

import json
import os
import sys
from pathlib import Path

TOOL = {
    "name": "measure",
    "description": "Measures the lamp.",
    "inputSchema": {"type": "object", "properties": {}},
}


def answer(method, params):
    if method == "initialize":
        capabilities = {"tools": {"listChanged": False}}
        about = {"name": "lamp", "version": "1"}
        return {
            "protocolVersion": params["protocolVersion"],
            "capabilities": capabilities,
            "serverInfo": about,
        }
    if method == "tools/list":
        return {"tools": [TOOL]}
    if method == "tools/call":
        place = Path(__file__).with_name("lamp.txt")
        try:
            place.write_text("out")
            changed = "changed it"
        except OSError:
            changed = "could not change it"
        text = f"the lamp reads {place.read_text()}, {os.environ['UNIT']}; {changed}"
        return {"content": [{"type": "text", "text": text}]}
    return {}


for line in sys.stdin:
    message = json.loads(line)
    if "id" in message and "method" in message:
        result = answer(message["method"], message.get("params") or {})
        print(json.dumps({"jsonrpc": "2.0", "id": message["id"], "result": result}), flush=True)
