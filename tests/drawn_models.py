"""Drawn model files: valid ones, and what can be wrong with them."""

import re

HEADER = '<robot name="c" xmlns:xacro="http://www.ros.org/wiki/xacro">'
_MASS = (
    '<inertial><mass value="5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)
_WORDS = (
    "a",
    "NaN",
    "inf",
    "-inf",
    "1e999",
    "1e308",
    "-1",
    "",
    "0",
    "9" * 400,
    "1 2",
    "1_0",
    "é",
    "${x}",
)


def urdf(more=""):
    """A base with two joints."""
    links = "".join(f'<link name="l{k}">{_MASS}</link>' for k in range(3))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        '<origin xyz="0 0 0.5" rpy="0 0 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" '
        'effort="10" velocity="1"/></joint>'
        for k in range(2)
    )
    return f"{HEADER}{links}{joints}{more}</robot>"


def with_expression(expression, more=""):
    return urdf(
        f'<xacro:property name="p" value="{expression}"/>{more}'
        '<frame name="f" link="l2" note="${p}"/>'
    )


SDF = (
    '<?xml version="1.0"?>\n<sdf version="1.7"><model name="m">\n'
    + "".join(
        f'<link name="l{k}">\n<pose>0 0 {k} 0 0 0</pose><inertial><mass>5</mass><inertia>'
        "<ixx>1</ixx>"
        '<iyy>1</iyy><izz>1</izz></inertia></inertial><visual name="v"><pose>0 0 0 0 0 0</pose>'
        "<geometry><box><size>1 1 1</size></box></geometry><material><diffuse>1 0 0 1</diffuse>"
        '</material></visual><sensor name="s" type="imu">\n\n</sensor></link>\n'
        for k in range(3)
    )
    + "".join(
        f'<joint name="j{k}" type="revolute"><parent>l{k}</parent><child>l{k + 1}</child><axis>'
        "<xyz>0 1 0</xyz>\n<limit><lower>-1</lower><upper>1</upper><effort>9</effort></limit>"
        "</axis></joint>\n"
        for k in range(2)
    )
    + "</model></sdf>"
)
MJCF = (
    '<mujoco model="m"><compiler angle="radian"/><size nkey="1"/><asset/><worldbody>'
    '<body name="l0"><freejoint/><inertial pos="0 0 0" mass="100" diaginertia="9 9 9"/>'
    '<geom type="box" size="1 1 1"/><replicate count="2" offset="0 0 1"><site/></replicate>'
    '<body name="l1" pos="0 0 0.5"><joint name="j0" axis="0 0 1" range="-1 1" limited="true"/>'
    '<inertial pos="0 0 0" mass="5" diaginertia="1 1 1"/><body name="l2" pos="0 0 0.5"><joint '
    'name="j1" axis="0 1 0" range="-1 1" limited="true"/><inertial pos="0 0 0" mass="5" '
    'diaginertia="1 1 1"/></body></body></body></worldbody><equality><joint joint1="j0" '
    'joint2="j1" active="false"/></equality><actuator><motor joint="j0" gear="2"/></actuator>'
    "</mujoco>"
)
VALID = {"urdf": urdf(), "xacro": with_expression("${1 + 2}"), "sdf": SDF, "xml": MJCF}


def mutated(rng, kind):
    """The bytes of a valid file of a kind with one to three faults."""
    text = VALID[kind]
    for _ in range(rng.integers(1, 4)):
        text = _FAULTS[rng.integers(len(_FAULTS))](rng, text)
    content = text.encode()
    match rng.integers(16):
        case 0:
            content = text.replace("name", "näme").encode("latin-1")
        case 1:
            content = text.encode("utf-16")
        case 2:
            content = content[: rng.integers(len(content))]
        case 3:
            content = b'<?xml version="1.0" encoding="nosuch"?>' + re.sub(
                rb"<\?.*?\?>", b"", content
            )
    return content


def _pick(rng, text, pattern):
    found = [*re.finditer(pattern, text)]
    return found[rng.integers(len(found))] if found else None


def _value(rng, text):
    found = _pick(rng, text, r'(?<==")[^"]*(?=")|(?<=>)[^<>\n]+(?=<)')
    return text[: found.start()] + rng.choice(_WORDS) + text[found.end() :] if found else text


def _twice(rng, text):
    found = _pick(rng, text, r"<(\w+)\b[^<>]*(?:/>|>[^<>]*</\1>)")
    return (
        text[: found.end()] + found[0] * int(rng.integers(1, 4)) + text[found.end() :]
        if found
        else text
    )


def _gone(rng, text):
    found = _pick(rng, text, r"<(\w+)\b[^<>]*(?:/>|>[^<>]*</\1>)|<\w+|</\w+>")
    return text[: found.start()] + text[found.end() :] if found else text


def _deep(rng, text):
    found, depth = _pick(rng, text, r"(?<=>)(?=<)"), int(rng.choice([10, 150, 5000]))
    tag = rng.choice(["a", "model", "body", "link"])
    if found is None:
        return text
    return text[: found.end()] + f"<{tag}>" * depth + f"</{tag}>" * depth + text[found.end() :]


_FAULTS = (_value, _value, _value, _twice, _gone, _deep)

_ESCAPES = (
    "(lambda: 1)()",
    "().__class__.__base__.__subclasses__()",
    "[c for c in (1,)]",
    "{1: 2}.items",
    "''.join",
    "'{0.__class__}'.format(1)",
    "__import__('os')",
    "open('x')",
    "eval('1')",
    "exec('1')",
    "math.__dict__",
    "python.__class__",
    "xacro.load_yaml('/etc/passwd')",
    "load_yaml('a')",
    "p.__init__",
    "getattr(1, 'real')",
    "vars()",
    "type(1)",
    "globals()",
    "f'{1}'",
    "(x := 1)",
    "[*range(3)]",
    "9**9**9",
    "'a'*10**10",
    "[0]*10**9",
    "'%999999999d' % 1",
    "'%*d' % (10**9, 1)",
    "range(10**12)",
    "2**(10**9)",
    "math.factorial(10**7)",
    "round(1, 10**9)",
    "str.mro",
    "list.__subclasses__()",
    "dict(**{})",
    "1 if ().__class__ else 0",
    "map(eval, ['1'])",
    "sorted([1], key=lambda x: x)",
    "b'x'",
    "1j",
    "...",
    "yield",
    "await x",
    "python.type(1)",
    "python.vars()",
    "print(1)",
    "breakpoint()",
    "xacro.message.__globals__",
    "xacro.arg.__globals__",
    "message",
    "math.sin.__self__",
    "[].append",
)


def hostile_expression(rng, command):
    """An expression that would reach Python, or that has no bound, within a harmless one."""
    system = (
        "(lambda: [c for c in ().__class__.__base__.__subclasses__() if c.__name__=='_wrap_close']"
        f"[0].__init__.__globals__['system']('{command}'))()"
    )
    inner = system if rng.random() < 0.3 else rng.choice(_ESCAPES)
    form = (
        "{}",
        "[{}][0]",
        "1 + {}",
        "str({})",
        "({}) if True else 0",
        "max({}, 1)",
        "{} and 1",
        "{{'a': {}}}['a']",
        "not {}",
        "list(map(str, [{}]))",
        "'%s' % {}",
    )
    return str(rng.choice(form)).format(inner)


def harmless_expression(rng, depth=3):
    """An expression with a value for xacro too."""
    if depth == 0 or rng.random() < 0.15:
        leaves = (
            "1",
            "2.5",
            "-3",
            "0.1",
            "'a'",
            "True",
            "pi",
            "x",
            "y",
            "names[1]",
            "table['k']",
            "1e3",
            "math.e",
        )
        return str(rng.choice(leaves))
    a, b, c = (harmless_expression(rng, depth - 1) for _ in range(3))
    forms = (
        "({a}) + ({b})",
        "({a}) - ({b})",
        "({a}) * ({b})",
        "({a}) / ({b})",
        "({a}) // ({b})",
        "({a}) % ({b})",
        "({a}) ** 2",
        "-({a})",
        "not ({a})",
        "({a}) < ({b}) <= ({c})",
        "({a}) == ({b})",
        "({a}) != ({b})",
        "({a}) and ({b})",
        "({a}) or ({b})",
        "({a}) if ({b}) else ({c})",
        "[{a}, {b}, {c}][1]",
        "({a}, {b})",
        "[{a}, {b}][::-1]",
        "len(str({a}))",
        "max(float({a}), float({b}))",
        "round({a}, 2)",
        "int({a})",
        "sin({a})",
        "math.cos({a})",
        "sqrt({a})",
        "math.atan2({a}, {b})",
        "radians({a})",
        "str({a})",
        "{{'u': {a}, 'v': {b}}}['v']",
        "({a}) in [{b}, {c}]",
        "list(map(str, [{a}, {b}]))",
        "bool({a})",
        "python.abs({a})",
        "python.sum([{a}, {b}])",
        "list(range(3))",
        "xacro.tokenize('a,b c')",
        "dict(a={a}, b={b})",
        "'%.3f' % ({a})",
        "python.sorted([{a}, {b}])",
        "abs_filename('a')",
        "({a}) is None",
    )
    return str(rng.choice(forms)).format(a=a, b=b, c=c)


def hostile_model(rng, kind, folder):
    """The bytes of a file of a kind that would take time or memory without end, or crash; a FIFO
    ``fifo`` is in the folder.
    """
    size, own, fifo = int(10 ** rng.uniform(4, 12)), f"{folder}/a.{kind}", f"{folder}/fifo"
    deep = int(10 ** rng.uniform(2, 4.5))
    file = str(rng.choice([own, f"a.{kind}", fifo, "fifo", "/dev/zero", str(folder)]))
    nested = rng.choice(["a", "body", "model", "link"])
    more = f"<{nested}>" * deep + f"</{nested}>" * deep
    if kind == "xacro":
        expression = rng.choice(
            [
                f"'a' * {size}",
                f"[0] * {size}",
                f"{size} ** {size}",
                f"range({size})",
                f"'%{size}d' % 1",
                f"math.factorial({size})",
                f"round(1, {size})",
                f"python.sum(range({size}))",
                f"list(range({size}))",
                f"list(map(str, range({size})))",
            ]
        )
        doubled = "".join(
            f'<xacro:property name="d{k + 1}" value="${{[d{k}, d{k}]}}"/>' for k in range(40)
        )
        return urdf(
            str(
                rng.choice(
                    [
                        f"${{{expression}}}",
                        more,
                        f'<xacro:include filename="{file}"/>' * int(rng.integers(1, 3)),
                        '<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>',
                        '<xacro:macro name="m"><xacro:m/><xacro:m/></xacro:macro><xacro:m/>',
                        f'<xacro:property name="d0" value="a"/>{doubled}${{d40}}',
                        "".join(
                            f'<xacro:macro name="m{k}">{f"<xacro:m{k - 1}/>" * 10 if k else "<a/>"}'
                            "</xacro:macro>"
                            for k in range(9)
                        )
                        + "<xacro:m8/>",
                        '<xacro:property name="u" value="${v}"/>'
                        '<xacro:property name="v" value="${u}"/>${u}',
                    ]
                )
            )
        ).encode()
    if kind == "xml":
        old, new = [
            ('count="2"', f'count="{size}"'),
            ('nkey="1"', f'nkey="{size}"'),
            ("<asset/>", more),
            (
                "<asset/>",
                f'<asset><hfield name="h" nrow="{size}" ncol="9" size="1 1 1 1"/></asset>',
            ),
            (
                "<asset/>",
                f'<asset><texture name="t" type="2d" builtin="flat" width="{size}" '
                'height="9"/></asset>',
            ),
            ("<asset/>", f'<asset><model name="m" file="{file}"/></asset>'),
            ("<asset/>", f'<include file="{file}"/>'),
            ("<asset/>", f'<asset><mesh name="h" file="{file}"/></asset>'),
            ("<asset/>", f'<size memory="{size}"/>'),
            ("<asset/>", f'<size nuserdata="{size}"/>'),
            ("<asset/>", f'<custom><numeric name="n" size="{size}"/></custom>'),
            ("<replicate", f'<composite type="cable" count="{size} 1 1"/><replicate'),
            (
                "<replicate",
                f'<flexcomp name="x" type="grid" count="{size} 2 2" spacing="1 1 1" '
                'dim="3"/><replicate',
            ),
            (
                "<replicate",
                "<replicate count='999'>" * 3 + "<site/>" + "</replicate>" * 3 + "<replicate",
            ),
        ][rng.integers(14)]
        return VALID[kind].replace(old, new).encode()
    if kind == "sdf":
        loop = '<joint name="z" type="fixed"><parent>l2</parent><child>l0</child></joint>'
        models = "".join(
            f'<model name="m{k}"><link name="b"/></model>' for k in range(min(deep, 3000))
        )
        new = rng.choice(
            [
                more,
                loop,
                f"<include><uri>{file}</uri></include>",
                f"<include><uri>file://{file}</uri></include>",
                f"<include><uri>file://{own}</uri></include>" * 2,
                models,
                f"<include><uri><![CDATA[{own}]]></uri></include>",
            ]
        )
        return VALID[kind].replace("</model>", f"{new}</model>").encode()
    mesh = f'<link name="x"><visual><geometry><mesh filename="{file}"/></geometry></visual></link>'
    many = "".join(f'<link name="n{k}"/>' for k in range(min(deep, 30_000)))
    loop = '<joint name="z" type="fixed"><parent link="l2"/><child link="l0"/></joint>'
    new = rng.choice([more, mesh, many, loop, "<!DOCTYPE a>"])
    return VALID[kind].replace("</robot>", f"{new}</robot>").encode()
