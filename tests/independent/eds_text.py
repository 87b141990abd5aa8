"""EDS files of our own, as text: a whole drive, and drives that lack or restrict objects."""

I8, I16, I32, U8, U16, U32, TEXT = 2, 3, 4, 5, 6, 7, 9

WHOLE: dict[str, tuple[int, str, object]] = {
    "1000": (U32, "ro", 0x00020192),
    "1001": (U8, "ro", 0),
    "1005": (U32, "rw", 0x80),
    "1006": (U32, "rw", 0),
    "1007": (U32, "rw", 0),
    "1008": (TEXT, "const", "witness"),
    "1014": (U32, "ro", "$NODEID+0x80"),
    "1016:1": (U32, "rw", 0),
    "1016:2": (U32, "rw", 0),
    "1017": (U16, "rw", 0),
    "1018:1": (U32, "ro", 0x1234),
    "1018:2": (U32, "ro", 0x402),
    "1018:3": (U32, "ro", 1),
    "1018:4": (U32, "ro", 7),
    "1019": (U8, "rw", 0),
    "1029:1": (U8, "rw", 0),
    "1400:1": (U32, "rw", "$NODEID+0x200"),
    "1400:2": (U8, "rw", 255),
    "1400:5": (U16, "rw", 0),
    "1800:1": (U32, "rw", "$NODEID+0x180"),
    "1800:2": (U8, "rw", 255),
    "1800:3": (U16, "rw", 0),
    "6007": (I16, "rw", 1),
    "603F": (U16, "ro", 0),
    "6040": (U16, "rww", 0),
    "6041": (U16, "ro", 0),
    "605A": (I16, "rw", 2),
    "6060": (I8, "rww", 0),
    "6061": (I8, "ro", 0),
    "6064": (I32, "ro", 0),
    "6071": (I16, "rww", 0),
    "6072": (U16, "rw", 1000),
    "6076": (U32, "rw", 5000),
    "6077": (I16, "ro", 0),
    "6080": (U32, "rw", 6000),
    "60B2": (I16, "rw", 0),
    "60C2:1": (U8, "rw", 1),
    "60C2:2": (I8, "rw", -3),
    "60E0": (U16, "rw", 1000),
    "60E1": (U16, "rw", 1000),
    "6502": (U32, "ro", 0x3A5),
    **{f"1600:{n}": (U32, "rw", 0) for n in range(9)},
    **{f"1A00:{n}": (U32, "rw", 0) for n in range(9)},
}
"""Index and sub-index to type, access and default value."""
_MAPPED = ("6040", "6041", "6060", "6061", "6064", "6071", "6077", "60B2")


def eds_text(*, without: tuple[str, ...] = (), **changed: tuple[int, str, object]) -> str:
    """Return the file of a drive that has all but some objects, and some otherwise.

    Parameters
    ----------
    without
        Objects that it does not have: "6072", or "1400:5".
    **changed
        Name with an x and an underscore, `x60E0` or `x1400_5`, to type, access and default.
    """
    objects = dict(WHOLE)
    for key, value in changed.items():
        objects[key.removeprefix("x").replace("_", ":")] = value
    left = {k: v for k, v in objects.items() if k not in without}
    left = {k: v for k, v in left.items() if k.partition(":")[0] not in without}
    groups: dict[str, dict[int, tuple[int, str, object]]] = {}
    for key, value in left.items():
        index, _, sub = key.partition(":")
        groups.setdefault(index, {})[int(sub) if sub else -1] = value
    lines = ["[FileInfo]", "FileName=witness.eds", "FileVersion=1", "EDSVersion=4.0", ""]
    lines += ["[DeviceInfo]", "VendorName=witness", "VendorNumber=0x1234", "ProductNumber=0x402"]
    lines += ["NrOfRXPDO=1", "NrOfTXPDO=1", "BaudRate_1000=1", ""]
    mandatory = [index for index in groups if index in ("1000", "1001", "1018")]
    for section, chosen in (
        ("MandatoryObjects", mandatory),
        ("OptionalObjects", [index for index in groups if index not in mandatory]),
    ):
        lines += [f"[{section}]", f"SupportedObjects={len(chosen)}"]
        lines += [f"{n}=0x{index}" for n, index in enumerate(chosen, 1)] + [""]
    for index, members in groups.items():
        if -1 in members:
            lines += [f"[{index}]", *_entry(index, *members[-1]), ""]
            continue
        if 0 not in members:
            members[0] = (U8, "ro", max(members))
        head = [f"ParameterName={index}", "ObjectType=0x9", f"SubNumber={len(members)}"]
        lines += [f"[{index}]", *head, ""]
        for sub, member in sorted(members.items()):
            kind = (U8, *member[1:]) if sub == 0 else member
            lines += [f"[{index}sub{sub}]", *_entry(f"{index} {sub}", *kind), ""]
    return "\n".join(lines)


def _entry(name: str, kind: int, access: str, default: object) -> list[str]:
    return [
        f"ParameterName={name}",
        "ObjectType=0x7",
        f"DataType=0x{kind:04X}",
        f"AccessType={access}",
        f"DefaultValue={default}",
        f"PDOMapping={int(name in _MAPPED)}",
    ]
