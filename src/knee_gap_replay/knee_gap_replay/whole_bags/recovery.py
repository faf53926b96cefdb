"""Recovery of a damaged bag: its complete messages, copied into a sound one."""

from typing import NamedTuple

from knee_gap_core.bag.bag import BagReader, BagWriter
from knee_gap_core.bag.errors import BagError
from knee_gap_core.bag.writing.mcap_storage import TopicRecord
from knee_gap_replay.whole_bags.output import refuse_input_as_output


class Recovered(NamedTuple):
    """Number of messages and topics saved, and one line for each part that was lost."""

    message_count: int
    topic_count: int
    losses: tuple[str, ...]


def recover(reader: BagReader, out: str, *, replace: bool = False) -> Recovered:
    """Copy every complete message of a bag, byte for byte and under its recorded name.

    `reader` is one that salvages. Raises BagError if nothing can be read, before anything is written.
    """
    refuse_input_as_output(str(reader.path), out)
    messages = reader.messages()
    if (first := next(messages, None)) is None:
        raise BagError(f"{reader.path} holds no message that can be read")
    with BagWriter(out, metadata=reader.metadata, replace=replace) as writer:
        for name, topic in reader.details.items():
            record = TopicRecord(
                name=name,
                msgtype=topic.msgtype,
                definition=topic.definition_bytes,
                type_hash=topic.type_hash,
                serialization=topic.encoding,
                encoding=topic.schema_encoding,
            )
            writer.copy_topic(record, topic.qos)
        writer.write_raw(first.topic, first.data, first.time_ns)
        for message in messages:
            writer.write_raw(message.topic, message.data, message.time_ns)
        return Recovered(writer.counts.total(), len(reader.details), reader.losses)
