"""A small DataFlash log of ArduPilot, written message by message with pymavlink, for the tests to read."""

import struct

from pymavlink.DFReader import DFFormat, DFMessage

# names, types and fields of messages, as ArduPilot declares them
DECLARED = {
    "FMT": (0x80, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": (0x40, "QNff", "TimeUS,Name,Value,Default"),
    "XKF4": (0x41, "QBcccccfffHBIHb", "TimeUS,C,SV,SP,SH,SM,SVT,errRP,OFN,OFE,FS,TS,SS,GPS,PI"),
    "NKF4": (0x42, "QcccccfffHBIHb", "TimeUS,SV,SP,SH,SM,SVT,errRP,OFN,OFE,FS,TS,SS,GPS,PI"),
    "XKFD": (0x43, "QBffffff", "TimeUS,C,IX,IY,IZ,IVX,IVY,IVZ"),
    "XKF0": (0x44, "QBBccccc", "TimeUS,C,ID,rng,innov,SIV,TR,BPN"),
}


class Flight:
    """A log in the making."""

    def __init__(self, *names):
        self.body = b""
        self.formats = {name: self._format(name, *DECLARED[name]) for name in ("FMT", "PARM", *names)}
        for each in self.formats.values():
            values = (each.type, each.len, each.name.encode(), each.format.encode(), ",".join(each.columns).encode())
            self.body += DFMessage(self.formats["FMT"], list(values), False, None).get_msgbuf()

    @staticmethod
    def _format(name, number, types, columns):
        return DFFormat(
            number, name, 3 + struct.calcsize(DFFormat(number, name, 0, types, columns).msg_struct), types, columns
        )

    def log(self, name, stamp, values):
        """One message; fields that are not given are zero."""
        form = self.formats[name]
        raw = [
            stamp if c == "TimeUS" else values.get(c, b"" if kind == "N" else 0)
            for c, kind in zip(form.columns, form.format, strict=True)
        ]
        raw = [round(100 * v) if kind == "c" else v for v, kind in zip(raw, form.format, strict=True)]
        self.body += DFMessage(form, raw, True, None).get_msgbuf()

    def set(self, gates):
        for name, value in gates.items():
            self.log("PARM", 0, {"Name": name.encode(), "Value": value})
        return self

    def write(self, path):
        path.write_bytes(self.body)
        return path
