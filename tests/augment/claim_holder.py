"""Another process that claims things; light to start.

claim_holder.py hold NAME URI ...                  claims, says so, and stays until it is killed
claim_holder.py leave NAME URI ...                 claims, and ends without releasing anything
claim_holder.py contend NAME (URI COUNT LOG) ...   holds it COUNT times; two never have LOG
"""

import os
import sys
import time

from augment.jobs.claims import try_claim
from augment.jobs.store import open_store


def contend(name: str, places: list[str]) -> None:
    """Hold the claim so many times at each place: URI, COUNT, LOG; one after the other.

    Raises:
        FileExistsError: two hold it at once. TimeoutError: it cannot be had.
    """
    deadline_s = time.monotonic() + 60
    for uri, count, log in zip(places[::3], places[1::3], places[2::3], strict=True):
        store, left = open_store(uri), int(count)
        while left:
            claim = try_claim(store, name)
            if claim is not None:
                with claim:
                    os.close(os.open(log, os.O_CREAT | os.O_EXCL))
                    claim.check()
                    time.sleep(0.002)
                    os.unlink(log)
                left -= 1
            elif time.monotonic() > deadline_s:
                raise TimeoutError(name)
            time.sleep(0.002)


def main() -> None:
    action, name, *rest = sys.argv[1:]
    if action == "contend":
        print("contending", flush=True)
        contend(name, rest)
        return
    claims = [try_claim(open_store(uri), name) for uri in rest]
    assert None not in claims
    print("holding", flush=True)
    if action == "hold":
        time.sleep(60)


if __name__ == "__main__":
    main()
