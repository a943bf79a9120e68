"""A small ULog, written by the public description of the format (docs.px4.io), for the tests to read."""

import struct

import numpy as np

TOPICS = ("estimator_innovations", "estimator_innovation_variances")
FIELDS = {"gps_hpos": 2, "gps_vpos": 1, "baro_vpos": 1, "mag_field": 3}  # of each topic, floats


def message(kind, data):
    return struct.pack("<HB", len(data), ord(kind)) + data


def declared(name, sample=True):
    stamps = "uint64_t timestamp;" + "uint64_t timestamp_sample;" * sample
    fields = "".join(f"float{f'[{size}]' if size > 1 else ''} {field};" for field, size in FIELDS.items())
    return message("F", f"{name}:{stamps}{fields}".encode())


def header():
    return b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000) + message("B", bytes(40))


class Flight:
    """A log in the making: messages of both topics, of any instance of the EKF2."""

    def __init__(self, topics=TOPICS, sample=True):
        self.topics, self.sample, self.ids = topics, sample, dict[tuple[str, int], int]()
        self.head = header() + b"".join(declared(topic, sample) for topic in topics)
        self.body = b""

    def log(self, topic, stamp, values, instance=0, late=40):
        """One message: ``stamp`` of the data, us, published ``late`` us later; fields that are not given are zero."""
        key = topic, instance
        if key not in self.ids:
            self.ids[key] = len(self.ids)
            self.body += message("A", struct.pack("<BH", instance, self.ids[key]) + topic.encode())
        each = [np.broadcast_to(np.asarray(values.get(name, 0.0), float), size) for name, size in FIELDS.items()]
        stamps = struct.pack("<QQ", stamp + late, stamp) if self.sample else struct.pack("<Q", stamp + late)
        numbers = np.concatenate([part.ravel() for part in each]).astype("<f4").tobytes()
        self.body += message("D", struct.pack("<H", self.ids[key]) + stamps + numbers)

    def other(self, topic, fields, instance=0):
        """One message of another topic: fields with their types, as ("Q", 7) of eight bytes or ("3f", (1, 2, 3))."""
        types = {"Q": "uint64_t", "I": "uint32_t", "B": "uint8_t", "f": "float", "d": "double"}
        key = topic, instance
        if key not in self.ids:
            if not any(name == topic for name, _ in self.ids):
                sizes = {name: f"[{kind[:-1]}]" if kind[:-1] else "" for name, (kind, _) in fields.items()}
                text = "".join(f"{types[kind[-1]]}{sizes[name]} {name};" for name, (kind, _) in fields.items())
                self.head += message("F", f"{topic}:{text}".encode())
            self.ids[key] = len(self.ids)
            self.body += message("A", struct.pack("<BH", instance, self.ids[key]) + topic.encode())
        data = b"".join(struct.pack(f"<{kind}", *np.atleast_1d(value)) for kind, value in fields.values())
        self.body += message("D", struct.pack("<H", self.ids[key]) + data)

    def both(self, stamp, values, instance=0):
        """Innovations and variances of one step, by field."""
        for k, topic in enumerate(self.topics):
            self.log(topic, stamp, {name: pair[k] for name, pair in values.items()}, instance, 40 + 5 * k)

    def lose(self, milliseconds):
        self.body += message("O", struct.pack("<H", milliseconds))

    def write(self, path):
        path.write_bytes(self.head + self.body)
        return path
