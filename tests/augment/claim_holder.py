"""Another process that claims things; light to start.

claim_holder.py hold URI NAME                claims, says so, and stays until it is killed
claim_holder.py leave URI NAME               claims, and ends without releasing it by itself
claim_holder.py contend URI NAME COUNT LOG   holds it COUNT times; LOG must never hold two
"""

import os
import sys
import time

from augment.batch.claims import ClaimTimes, try_claim
from augment.batch.store import open_store

TIMES = ClaimTimes(renewal_s=0.1, lifetime_s=0.5, attempts=4, longest_wait_s=0.02)
PATIENT = ClaimTimes(renewal_s=5.0, lifetime_s=60.0, attempts=4, longest_wait_s=0.02)


def contend(uri: str, name: str, count: int, log: str) -> None:
    """Hold the claim `count` times; the file `log` is made and deleted by whoever holds it.

    Raises:
        FileExistsError: two hold it at once. TimeoutError: it cannot be had.
    """
    store, deadline_s = open_store(uri), time.monotonic() + 60
    while count:
        claim = try_claim(store, name, PATIENT)
        if claim is not None:
            with claim:
                os.close(os.open(log, os.O_CREAT | os.O_EXCL))
                claim.check()
                time.sleep(0.002)
                os.unlink(log)
            count -= 1
        elif time.monotonic() > deadline_s:
            raise TimeoutError(name)
        time.sleep(0.002)


def main() -> None:
    action, uri, name, *rest = sys.argv[1:]
    if action == "contend":
        contend(uri, name, int(rest[0]), rest[1])
        return
    assert try_claim(open_store(uri), name, TIMES) is not None
    print("holding", flush=True)
    if action == "hold":
        time.sleep(60)


if __name__ == "__main__":
    main()
