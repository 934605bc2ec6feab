"""Makes a long log of a short one, to measure memory: ``python -m tests.tools.long_log LOG OUT --times 10``.

The messages are repeated as often as asked, each repetition later by the length of the log, in the stamps inside the
messages as well. So the person jumps back where a repetition begins.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from hrcreplay.logs import skeleton_pb2 as pb

#: Stamp of each kind of message; a kind without one is written once.
STAMPS = {"hrcreplay.Skeleton": (pb.Skeleton, "capture_ns"), "hrcreplay.Truth": (pb.Truth, "t_ns")}


def repeat(log: Path, out: Path, times: int, *, truth: bool = False) -> None:
    """Writes a log that repeats another one of hrcreplay's own format.

    Args:
        log: Log to repeat.
        out: Log to write.
        times: Number of repetitions.
        truth: Also write the ground truth.
    """
    with log.open("rb") as source:
        messages = [(schema, channel, message) for schema, channel, message in make_reader(source).iter_messages()]
    first, last = messages[0][2].log_time, messages[-1][2].log_time
    length_ns = last - first + 33_000_000
    channels: dict[str, int] = {}
    with out.open("wb") as target:
        writer = Writer(target, compression=CompressionType.ZSTD)
        writer.start()
        for number in range(times):
            for schema, channel, message in messages:
                kind = "" if schema is None else schema.name
                if schema is None or (kind == "hrcreplay.Truth" and not truth) or (number and kind not in STAMPS):
                    continue
                if channel.topic not in channels:
                    known = writer.register_schema(kind, schema.encoding, schema.data)
                    channels[channel.topic] = writer.register_channel(channel.topic, "protobuf", known)
                data = message.data
                if kind in STAMPS:
                    make, stamp = STAMPS[kind]
                    body = make.FromString(data)
                    setattr(body, stamp, getattr(body, stamp) + number * length_ns)
                    data = body.SerializeToString(deterministic=True)
                at_ns = message.log_time + number * length_ns
                writer.add_message(channels[channel.topic], log_time=at_ns, data=data, publish_time=at_ns)
        writer.finish()  # type: ignore[no-untyped-call]


def main(arguments: list[str] | None = None) -> None:
    """Writes the log."""
    parser = argparse.ArgumentParser(prog="python -m tests.tools.long_log", description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--times", type=int, default=10, help="number of repetitions")
    parser.add_argument("--truth", action="store_true", help="repeat the ground truth, too")
    options = parser.parse_args(arguments)
    repeat(options.log, options.out, options.times, truth=options.truth)


if __name__ == "__main__":
    main()
