"""Small descriptions of huge robots, as MJCF and URDF; each writes one file."""

import struct
import zlib

BODY = '<body><joint/><geom size="1"/>{}</body>'


def _mjcf(path, world="", rest=""):
    path.write_text(f"<mujoco>{rest}<worldbody>{world}</worldbody></mujoco>")


def mjcf_of_many_copies(path):
    _mjcf(path, f'<replicate count="1000000000">{BODY.format("")}</replicate>')


def mjcf_of_copies_of_copies(path):
    world = BODY.format("")
    for _ in range(9):
        world = f'<replicate count="30">{world}</replicate>'
    _mjcf(path, world)


def mjcf_of_almost_too_many_copies(path):
    _mjcf(path, f'<replicate count="1330">{BODY.format("")}</replicate>')


def mjcf_of_a_huge_cable(path):
    cable = '<flexcomp name="f" type="grid" count="3000 3000 3000" spacing="1 1 1" mass="1"/>'
    _mjcf(path, f'<body name="b">{cable}</body>')


def mjcf_of_a_huge_height_field(path):
    field = '<hfield name="h" nrow="50000" ncol="50000" size="1 1 1 1"/>'
    _mjcf(path, rest=f"<asset>{field}</asset>")


def mjcf_of_a_huge_texture(path):
    texture = '<texture name="t" builtin="flat" width="10000" height="10000"/>'
    _mjcf(path, rest=f"<asset>{texture}</asset>")


def mjcf_of_a_huge_picture(path):
    """A PNG file of 30 kB with 40 000 × 20 000 pixels."""

    def chunk(kind, data):
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    head = struct.pack(">IIBBBBB", 40_000, 20_000, 8, 0, 0, 0, 0)
    pixels = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(30_000_000), 9))
    (path.parent / "t.png").write_bytes(b"\x89PNG\r\n\x1a\n" + pixels + chunk(b"IEND", b""))
    _mjcf(path, rest='<asset><texture name="t" type="2d" file="t.png"/></asset>')


def mjcf_of_much_memory(path):
    _mjcf(path, rest='<size memory="100T"/>')


def mjcf_of_many_keyframes(path):
    _mjcf(path, BODY.format(""), rest='<size nkey="100000000"/>')


def mjcf_of_many_user_numbers(path):
    _mjcf(path, BODY.format("") * 1_000, rest='<size nuser_body="100000"/>')


def mjcf_of_a_wide_sensor(path):
    _mjcf(path, rest='<sensor><user dim="100000000"/></sensor>')


def mjcf_of_entities(path):
    entities = '<!ENTITY a "xxxxxxxxxx">' + "".join(
        f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">' for k in range(9)
    )
    path.write_text(f"<!DOCTYPE m [{entities}]><mujoco model='&j;'/>")


def mjcf_of_nested_bodies(path):
    _mjcf(path, "<body>" * 100_000 + "</body>" * 100_000)


def mjcf_of_many_bodies(path):
    _mjcf(path, BODY.format("") * 300_000)


def mjcf_of_itself(path):
    model = f'<asset><model name="m" file="{path.name}"/></asset>'
    _mjcf(path, '<frame><attach model="m" prefix="a"/></frame>' * 2, rest=model)


def mjcf_of_models_of_models(path):
    for k in range(30):
        name = path.name if k == 0 else f"{k}.xml"
        model = f'<asset><model name="m" file="{k + 1}.xml"/></asset>'
        world = "".join(f'<frame><attach model="m" prefix="{a}"/></frame>' for a in "ab")
        _mjcf(path.with_name(name), world, rest=model)
    _mjcf(path.with_name("30.xml"), BODY.format(""))


def mjcf_of_long_text(path):
    path.write_text(f"<mujoco model='{'x' * 40_000_000}'/>")


def _urdf(path, content):
    path.write_text(f'<robot name="r"><link name="base"/>{content}</robot>')


def _link(number, parent):
    return (
        f'<link name="l{number}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" '
        f'ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{number}" type="revolute">'
        f'<parent link="{parent}"/><child link="l{number}"/><axis xyz="0 0 1"/></joint>'
    )


def urdf_of_many_links(path):
    _urdf(path, "".join(_link(k, "base") for k in range(50_000)))


def urdf_of_a_thousand_links(path):
    _urdf(path, "".join(_link(k, "base") for k in range(1_100)))


def urdf_of_a_long_chain(path):
    links = (_link(k, f"l{k - 1}" if k else "base") for k in range(1_100))
    _urdf(path, "".join(links))


def urdf_of_a_circle(path):
    _urdf(path, _link(0, "l1") + _link(1, "l0"))


def urdf_of_nested_elements(path):
    _urdf(path, "<a>" * 200_000 + "</a>" * 200_000)


def urdf_of_entities(path):
    mjcf_of_entities(path)


def urdf_of_long_text(path):
    _urdf(path, f'<link name="{"x" * 40_000_000}"/>')


def urdf_of_many_attributes(path):
    _urdf(path, "<link " + " ".join(f'a{k}="1"' for k in range(500_000)) + "/>")


def urdf_of_a_huge_mesh(path):
    """A mesh of 8 GB that takes no room on the disk."""
    with path.with_name("m.stl").open("wb") as file:
        file.truncate(8 * 2**30)
    mesh = '<geometry><mesh filename="m.stl"/></geometry>'
    _urdf(path, f'<link name="l"><visual>{mesh}</visual><collision>{mesh}</collision></link>')


def urdf_of_a_mesh_with_many_faces(path):
    """A binary mesh of 100 bytes that says that it has a billion faces."""
    path.with_name("m.stl").write_bytes(bytes(80) + struct.pack("<I", 10**9) + bytes(16))
    mesh = '<geometry><mesh filename="m.stl"/></geometry>'
    _urdf(path, f'<link name="l"><collision>{mesh}</collision></link>')


BOMBS = {
    kind: {name: make for name, make in globals().items() if name.startswith(f"{kind}_of")}
    for kind in ("mjcf", "urdf")
}
