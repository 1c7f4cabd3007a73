"""What has to be told of this API."""

import schemathesis

# A piece of an upload is bytes like any other.
schemathesis.serializer.alias("application/offset+octet-stream", "application/octet-stream")

# What a lab of the run needs, by a wide margin.
ENOUGH = 10**12


@schemathesis.hook
def before_call(context, case, kwargs):
    """Who sets the limits of its own lab to next to nothing is refused (507) from then on, as it should be."""
    if case.operation.label == "PATCH /v1/labs/{lab}" and isinstance(case.body, dict):
        for limit in ("bytes", "jobs"):
            if type(case.body.get(limit)) is int and 0 <= case.body[limit] < ENOUGH:
                case.body[limit] = ENOUGH
