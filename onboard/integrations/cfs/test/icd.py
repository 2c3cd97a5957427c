"""The interface control document of the app, in XTCE, made from the headers of its messages.

    python icd.py --write ../starcat.xml       write it
    python icd.py --check ../starcat.xml       compare it with the headers
                                --build FOLDER               and its offsets with the C compiler
                                --recording run.ccsds        and decode a recording with it

The compiler is CC with INCLUDES of the environment. The recording is decoded by
space_packet_parser, which also has the schema of XTCE; without that package this part is skipped,
with a message.
"""

from __future__ import annotations

import argparse
import os
import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1]
CONFIG = FOLDER / "config"
XTCE = "http://www.omg.org/spec/XTCE/20180204"
BASE = {"CMD": 0x1800, "TLM": 0x0800}
"""Message identifiers of topics, as cFE has them if a mission does not say otherwise."""

SIZES = {"uint8": 8, "uint16": 16, "uint32": 32, "int16": 16, "float": 32, "double": 64, "char": 8}
FORMATS = {"uint8": "B", "uint16": "H", "uint32": "I", "int16": "h", "float": "f", "double": "d"}
TELEMETRY = {"FRAME": "FrameTlm", "ATTITUDE": "AttitudeTlm", "HK": "HkTlm"}
COMMANDS = {
    "NOOP": None,
    "RESET_COUNTERS": None,
    "LOAD_IMAGE": "LoadImage",
    "SWITCH_IMAGE": None,
    "SET_CAMERA": "SetCamera",
    "ENABLE_TRACKING": None,
    "DISABLE_TRACKING": None,
    "SET_BUDGET": "SetBudget",
    "LOAD_PATCH": "LoadPatch",
}
ENUMERATED = {
    "Status": "status",
    "LastStatus": "status",
    "ImageStatus": "status",
    "Reason": "reason",
    "Mode": "MODE",
    "CameraSource": "CAMERA_OF",
    "LoadState": "LOAD",
}
"""Members whose numbers have names: an enumeration of starcat.h, or a prefix of defines."""


@dataclass(frozen=True)
class Member:
    """A member of a structure. `count` is 0 if it is not an array."""

    kind: str
    name: str
    count: int
    text: str


@dataclass(frozen=True)
class Headers:
    """What the headers say: structures by name, constants, and enumerations of the library."""

    structures: dict[str, list[Member]]
    constants: dict[str, int]
    enumerations: dict[str, dict[int, str]]


def read_headers() -> Headers:
    text = "".join(
        (CONFIG / f"default_starcat_app_{name}.h").read_text(encoding="utf-8")
        for name in ("fcncodes", "interface_cfg", "topicids", "msgdefs")
    )
    constants = {
        name: int(value, 0)
        for name, value in re.findall(r"#define (\w+) +(\w+)", text)
        if value[0].isdigit()
    }
    structures = {}
    pattern = r"typedef struct \{\n(.*?)\} STARCAT_APP_(\w+)_t;"
    for body, name in re.findall(pattern, text, re.DOTALL):
        members = []
        for line in body.splitlines():
            found = re.fullmatch(r" +(\w+) (\w+)(?:\[(\w+)\])?; +/\* (.+) \*/", line)
            if found is None:
                raise SystemExit(f"icd: {name}: a member and what it is, not {line!r}")
            kind, member, length, said = found.groups()
            count = 0 if length is None else constants.get(length) or int(length)
            members.append(Member(kind, member, count, said))
        structures[name] = members
    library = (FOLDER.parents[1] / "include" / "starcat.h").read_text(encoding="utf-8")
    enumerations = {}
    for body, name in re.findall(r"typedef enum \{(.*?)\} starcat_(\w+);", library, re.DOTALL):
        pairs = re.findall(r"STARCAT_(\w+) = (-?\d+)", body)
        enumerations[name] = {int(value): constant for constant, value in pairs}
    for prefix in ("MODE", "CAMERA_OF", "LOAD"):
        start = f"STARCAT_APP_{prefix}_"
        enumerations[prefix] = {
            value: name.removeprefix(start)
            for name, value in constants.items()
            if name.startswith(start) and not name.endswith("_CC")
        }
    return Headers(structures, constants, enumerations)


def flatten(headers: Headers, structure: str, prefix: str = "") -> list[Member]:
    """Return the members of a structure; a structure in it is replaced by its own members."""
    members: list[Member] = []
    for member in headers.structures[structure]:
        if member.kind in SIZES:
            members.append(Member(member.kind, prefix + member.name, member.count, member.text))
        else:
            inner = member.kind.removeprefix("STARCAT_APP_").removesuffix("_t")
            members += flatten(headers, inner, f"{prefix}{member.name}_")
    return members


def is_text(member: Member) -> bool:
    return member.kind == "char"


def is_bytes(member: Member) -> bool:
    return member.kind == "uint8" and member.count > 8


def elements(member: Member) -> list[str]:
    """Names of a member's elements in XTCE: each number of an array is an element."""
    if member.count == 0 or is_text(member) or is_bytes(member):
        return [member.name]
    width = len(str(member.count - 1))
    return [f"{member.name}_{n:0{width}}" for n in range(member.count)]


def type_name(member: Member) -> str:
    last = member.name
    if last in ENUMERATED:
        return f"{ENUMERATED[last]}_{member.kind}"
    if is_text(member) or is_bytes(member):
        return f"{'text' if is_text(member) else 'bytes'}_{member.count}"
    return member.kind


def add(parent: ET.Element, tag: str, text: str | None = None, **attributes: str) -> ET.Element:
    element = ET.SubElement(parent, tag, attributes)
    element.text = text
    return element


def add_encoding(parent: ET.Element, kind: str, count: int, order: str) -> None:
    if kind == "char":
        encoding = add(parent, "StringDataEncoding", encoding="UTF-8")
        fixed = add(add(encoding, "SizeInBits"), "Fixed")
        add(fixed, "FixedValue", str(8 * count))
    elif count > 0:
        encoding = add(parent, "BinaryDataEncoding")
        add(add(encoding, "SizeInBits"), "FixedValue", str(8 * count))
    elif kind in ("float", "double"):
        size = str(SIZES[kind])
        add(parent, "FloatDataEncoding", encoding="IEEE754", sizeInBits=size, byteOrder=order)
    else:
        signed = "unsigned" if kind[0] == "u" else "twosComplement"
        size = str(SIZES[kind])
        add(parent, "IntegerDataEncoding", encoding=signed, sizeInBits=size, byteOrder=order)


def add_type(types: ET.Element, role: str, member: Member, headers: Headers) -> None:
    """Add the type of a member to a set of types, once."""
    name, kind = type_name(member), member.kind
    if any(known.get("name") == name for known in types):
        return
    order = "leastSignificantByteFirst"
    if member.name in ENUMERATED:
        element = add(types, f"Enumerated{role}Type", name=name)
        add_encoding(element, kind, 0, order)
        values = add(element, "EnumerationList")
        for value, label in headers.enumerations[ENUMERATED[member.name]].items():
            add(values, "Enumeration", value=str(value), label=label)
    elif is_text(member) or is_bytes(member):
        shape = "String" if is_text(member) else "Binary"
        add_encoding(add(types, f"{shape}{role}Type", name=name), kind, member.count, order)
    elif kind in ("float", "double"):
        size = str(SIZES[kind])
        add_encoding(add(types, f"Float{role}Type", name=name, sizeInBits=size), kind, 0, order)
    else:
        signed = "false" if kind[0] == "u" else "true"
        size = str(SIZES[kind])
        element = add(types, f"Integer{role}Type", name=name, sizeInBits=size, signed=signed)
        add_encoding(element, kind, 0, order)


HEADER = (
    ("VERSION", 3),
    ("TYPE", 1),
    ("SEC_HDR_FLG", 1),
    ("PKT_APID", 11),
    ("SEQ_FLGS", 2),
    ("SRC_SEQ_CTR", 14),
    ("PKT_LEN", 16),
    ("TIME_SECONDS", 32),
    ("TIME_SUBSECONDS", 16),
    ("HEADER_SPARE", 32),
)
"""Bits of the headers of telemetry: six bytes of CCSDS, ten of cFE."""


def message_id(headers: Headers, topic: str, base: str) -> int:
    return BASE[base] | headers.constants[f"CFE_MISSION_STARCAT_APP_{topic}_TOPICID"]


def add_telemetry(root: ET.Element, headers: Headers) -> None:
    telemetry = add(root, "TelemetryMetaData")
    types, parameters = add(telemetry, "ParameterTypeSet"), add(telemetry, "ParameterSet")
    containers = add(telemetry, "ContainerSet")
    first = add(containers, "SequenceContainer", name="CCSDSPacket", abstract="true")
    entries = add(first, "EntryList")
    for name, bits in HEADER:
        element = add(types, "IntegerParameterType", name=f"{name}_type", signed="false")
        add(element, "IntegerDataEncoding", encoding="unsigned", sizeInBits=str(bits))
        add(parameters, "Parameter", name=name, parameterTypeRef=f"{name}_type")
        add(entries, "ParameterRefEntry", parameterRef=name)
    for topic, structure in TELEMETRY.items():
        container = add(containers, "SequenceContainer", name=topic)
        entries = add(container, "EntryList")
        for member in flatten(headers, f"{structure}_Payload"):
            add_type(types, "Parameter", member, headers)
            for name in elements(member):
                add(
                    parameters,
                    "Parameter",
                    name=f"{topic}_{name}",
                    parameterTypeRef=type_name(member),
                    shortDescription=member.text,
                )
                add(entries, "ParameterRefEntry", parameterRef=f"{topic}_{name}")
        base = add(container, "BaseContainer", containerRef="CCSDSPacket")
        compared = add(add(base, "RestrictionCriteria"), "ComparisonList")
        apid = message_id(headers, f"{topic}_TLM", "TLM") & 0x7FF
        add(compared, "Comparison", parameterRef="TYPE", value="0")
        add(compared, "Comparison", parameterRef="PKT_APID", value=str(apid))


def add_commands(root: ET.Element, headers: Headers) -> None:
    commands = add(root, "CommandMetaData")
    types = ET.Element("ArgumentTypeSet")
    commands.append(types)
    every = add(commands, "MetaCommandSet")
    for name, structure in {**COMMANDS, "SEND_HK": None, "WAKEUP": None}.items():
        topic = "CMD" if name in COMMANDS else name
        members = [] if structure is None else flatten(headers, f"{structure}_Payload")
        command = add(every, "MetaCommand", name=name)
        if members:
            arguments = add(command, "ArgumentList")
        container = add(command, "CommandContainer", name=f"{name}_packet")
        entries = add(container, "EntryList")
        size = 8 + sum(max(member.count, 1) * SIZES[member.kind] // 8 for member in members)
        code = headers.constants.get(f"STARCAT_APP_{name}_CC", 0)
        packet = struct.pack(">HHHBB", message_id(headers, topic, "CMD"), 0xC000, size - 7, code, 0)
        add(entries, "FixedValueEntry", name="Header", binaryValue=packet.hex(), sizeInBits="64")
        for member in members:
            add_type(types, "Argument", member, headers)
            add(
                arguments,
                "Argument",
                name=member.name,
                argumentTypeRef=type_name(member),
                shortDescription=member.text,
            )
            add(entries, "ArgumentRefEntry", argumentRef=member.name)


def render(headers: Headers) -> str:
    root = ET.Element(
        "SpaceSystem",
        {
            "xmlns": XTCE,
            "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
            "xsi:schemaLocation": f"{XTCE} {XTCE.replace('http:', 'https:')}/SpaceSystem.xsd",
            "name": "STARCAT_APP",
            "shortDescription": "Messages of starcat's app for cFS; numbers of a little-endian "
            "processor. Written by test/icd.py of the app's headers.",
        },
    )
    add_telemetry(root, headers)
    add_commands(root, headers)
    ET.indent(root, " ")
    said = '<?xml version="1.0" encoding="UTF-8"?>\n<!-- SPDX-License-Identifier: MIT -->\n'
    return said + ET.tostring(root, encoding="unicode") + "\n"


def layout(headers: Headers, structure: str) -> tuple[dict[str, int], int]:
    """Return the offset of each member, by XTCE's order without gaps, and the size."""
    offsets, at = {}, 0
    for member in flatten(headers, structure):
        offsets[member.name] = at
        at += max(member.count, 1) * SIZES[member.kind] // 8
    return offsets, at


def check_compiler(headers: Headers, build: Path) -> list[str]:
    """Compare offsets, sizes and message identifiers with the C compiler."""
    expected, lines = [], []
    for name in [*TELEMETRY.values(), *filter(None, COMMANDS.values())]:
        structure = f"STARCAT_APP_{name}_Payload_t"
        offsets, size = layout(headers, f"{name}_Payload")
        for member, offset in offsets.items():
            path = member.replace("Camera_", "Camera.") if name == "SetCamera" else member
            lines.append(f'  (void)printf("%u\\n", (unsigned)offsetof({structure}, {path}));')
            expected.append((f"{structure}.{member}", offset))
        lines.append(f'  (void)printf("%u\\n", (unsigned)sizeof({structure}));')
        expected.append((structure, size))
    topics = {f"{topic}_TLM": "TLM" for topic in TELEMETRY}
    topics |= dict.fromkeys(("CMD", "SEND_HK", "WAKEUP"), "CMD")
    for topic, base in topics.items():
        lines.append(f'  (void)printf("%u\\n", (unsigned)STARCAT_APP_{topic}_MID);')
        expected.append((f"STARCAT_APP_{topic}_MID", message_id(headers, topic, base)))
    source, program = build / "offsets.c", build / "offsets"
    included = ["<stddef.h>", "<stdio.h>", '"starcat_app_msgdefs.h"', '"starcat_app_msgids.h"']
    source.write_text(
        "".join(f"#include {name}\n" for name in included)
        + "int main(void) {\n"
        + "\n".join(lines)
        + "\n  return 0;\n}\n"
    )
    command = [os.environ.get("CC", "cc"), *os.environ.get("INCLUDES", "").split()]
    subprocess.run([*command, str(source), "-o", str(program)], check=True)
    ran = subprocess.run([str(program)], capture_output=True, text=True, check=True)
    print(f"  offsets, sizes, identifiers   {len(expected):6}")
    return [
        f"{name} is {number}, not {wanted}"
        for (name, wanted), number in zip(expected, ran.stdout.split(), strict=True)
        if int(number) != wanted
    ]


def packets_of(recording: bytes) -> list[bytes]:
    packets, at = [], 0
    while at < len(recording):
        size = int.from_bytes(recording[at + 4 : at + 6], "big") + 7
        packets.append(recording[at : at + size])
        at += size
    return packets


def value_at(payload: bytes, offset: int, member: Member) -> list[object]:
    """Read a member at its offset in a payload."""
    if is_text(member) or is_bytes(member):
        return [payload[offset : offset + member.count]]
    count = max(member.count, 1)
    return list(struct.unpack_from(f"<{count}{FORMATS[member.kind]}", payload, offset))


def decode(definition: object, packet: bytes) -> dict[str, object]:
    """Decode a packet by the ICD; enumerations become their numbers, and text becomes bytes."""
    values: dict[str, object] = {}
    for name, value in definition.parse_bytes(packet).items():  # type: ignore[attr-defined]
        raw = getattr(value, "raw_value", value)
        values[name] = raw.encode() if isinstance(raw, str) else raw
    return values


def check_commands(icd: Path, packets: list[bytes]) -> list[str]:
    """Return the commands of the ICD whose header is not in any packet of the recording."""
    sent = {packet[:2] + packet[4:7] for packet in packets}  # identifier, length, code
    wrong = []
    commands = ET.parse(icd).findall(f".//{{{XTCE}}}MetaCommand")
    for command in commands:
        header = command.find(f".//{{{XTCE}}}FixedValueEntry")
        expected = bytes.fromhex("" if header is None else header.get("binaryValue", ""))
        if expected[:2] + expected[4:7] not in sent:
            wrong.append(f"no packet of the recording is {command.get('name')}")
    print(f"  commands as in the ICD        {len(commands) - len(wrong):6} of {len(commands)}")
    return wrong


def check_recording(headers: Headers, icd: Path, recording: Path) -> list[str]:
    """Decode each packet of telemetry by the ICD, and compare it with the bytes of the packet."""
    try:
        from space_packet_parser.xtce.definitions import XtcePacketDefinition
        from space_packet_parser.xtce.validation import validate_xtce
    except ImportError:
        print("  decoded by the ICD           not, as space_packet_parser is missing")
        return []
    wrong = [str(error) for error in validate_xtce(str(icd), level="all").errors]
    definition = XtcePacketDefinition.from_xtce(str(icd))
    apids = {
        message_id(headers, f"{topic}_TLM", "TLM"): (topic, structure)
        for topic, structure in TELEMETRY.items()
    }
    n_packets = n_values = 0
    for packet in packets_of(recording.read_bytes()):
        topic, structure = apids.get(int.from_bytes(packet[:2], "big"), ("", ""))
        offsets, size = layout(headers, f"{structure}_Payload") if topic else ({}, 0)
        if not topic or len(packet) != 16 + size:
            continue
        values = decode(definition, packet)
        n_packets += 1
        for member in flatten(headers, f"{structure}_Payload"):
            raw = value_at(packet[16:], offsets[member.name], member)
            for name, expected in zip(elements(member), raw, strict=True):
                n_values += 1
                if values[f"{topic}_{name}"] != expected:
                    wrong.append(f"{topic}_{name} is {values[f'{topic}_{name}']}, not {expected}")
    print(f"  packets decoded by the ICD    {n_packets:6}, {n_values} values")
    return wrong if n_packets else ["the recording has no telemetry of the app"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--write", type=Path, metavar="FILE")
    parser.add_argument("--check", type=Path, metavar="FILE")
    parser.add_argument("--build", type=Path, metavar="FOLDER")
    parser.add_argument("--recording", type=Path, metavar="FILE")
    given = parser.parse_args()
    headers = read_headers()
    if given.write is not None:
        given.write.write_text(render(headers), encoding="utf-8")
    wrong: list[str] = []
    if given.check is not None and given.check.read_text(encoding="utf-8") != render(headers):
        wrong.append(f"{given.check} is not what the headers say; write it with --write")
    if given.build is not None:
        wrong += check_compiler(headers, given.build)
    if given.recording is not None and given.check is not None:
        wrong += check_commands(given.check, packets_of(given.recording.read_bytes()))
        wrong += check_recording(headers, given.check, given.recording)
    for line in wrong[:20]:
        print(f"icd: {line}", file=sys.stderr)
    return min(len(wrong), 1)


if __name__ == "__main__":
    sys.exit(main())
