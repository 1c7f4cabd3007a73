"""Verify notifications with the library of Standard Webhooks: one JSON object [headers, body] per line of the input.

    python read_webhook.py SECRET
"""
import json
import sys

from standardwebhooks import Webhook

hook = Webhook(sys.argv[1])
for line in sys.stdin:
    headers, body = json.loads(line)
    print(json.dumps(hook.verify(body, headers)))
