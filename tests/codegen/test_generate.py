"""Generated files are current and contain the definitions."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import msgspec
import pytest

from iris_session.protocol import assets, client_messages, names, scene, server_messages
from tools.codegen import __main__ as generate
from tools.codegen import csharp, schema, typescript

ROOT = Path(__file__).parents[2]


# Packed bytes of arrays and deformables depend on the version of zlib: their own tests compare decoded values.
@pytest.mark.parametrize(
    "target",
    [*(name for name in generate.TARGETS if name not in ("arrays", "deformable")), generate.UNITY_META],
)
def test_generated_files_are_current(target: str) -> None:
    outdated = [str(path.relative_to(ROOT)) for path, _ in generate.find_outdated(ROOT, [target])]
    assert outdated == [], f"run: python -m tools.codegen {target}"


def test_check_fails_for_a_stale_file_and_writing_repairs_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for relative, _ in generate.TARGETS.values():
        (tmp_path / relative).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / relative, tmp_path / relative)
    (tmp_path / "docs/protocol/golden.json").unlink()
    text = tmp_path / "docs/protocol.md"
    text.write_text(text.read_text().replace("| `clutch` |", "| `clasp` |"))
    root = ["--root", str(tmp_path)]
    assert generate.main(["docs", "--check", *root]) == 1
    assert generate.main(["typescript", "--check", *root]) == 0
    stray = tmp_path / "unity_client/Runtime/Gone.cs.meta"
    stray.write_text("guid: 0")
    assert generate.main(["all", *root]) == 0
    wrote = [line.split(": ")[1] for line in capsys.readouterr().out.splitlines()]
    assert [path for path in wrote if not path.endswith(".meta")] == [
        "docs/protocol.md",
        "docs/protocol/golden.json",
        "docs/protocol.md",
    ]
    assert not stray.exists()
    assert generate.main(["all", "--check", *root]) == 0
    assert generate.main(["docs", "--check", *root]) == 0
    assert text.read_text() == (ROOT / "docs/protocol.md").read_text()


def test_generator_needs_a_checkout_and_its_markers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        generate.main(["all", "--root", str(tmp_path)])
    assert str(tmp_path) in capsys.readouterr().err
    with pytest.raises(ValueError, match="<!-- generated:values -->"):
        generate.update_document("# Protocol\n")


def test_every_struct_is_in_the_schema() -> None:
    """A struct that is defined for the wire and not listed would be missing in every generated file."""
    listed = {struct.name for struct in schema.list_all_structs()}
    for module in (client_messages, server_messages, scene, assets):
        for name, value in vars(module).items():
            if isinstance(value, type) and issubclass(value, msgspec.Struct) and value.__module__ == module.__name__:
                assert name in listed | {"Message", "EventBody"}, name
    assert len(listed) == len(schema.list_all_structs())


def test_descriptions_of_open_enumerations_are_complete() -> None:
    """Not up to the first line, which may end within a sentence."""
    for name in schema.list_enums():
        doc = schema.find_enum_doc(name)
        kind = getattr(names, name)
        assert doc.split() == (kind.__doc__ or "").split()
        assert not doc or doc.endswith("."), name


def test_schema_follows_the_definitions() -> None:
    by_name = {struct.name: struct for struct in schema.list_all_structs()}
    sample = {field.name: field for field in by_name["Sample"].fields}
    assert [field.name for field in by_name["Sample"].fields] == list(client_messages.Sample.__struct_fields__)
    assert sample["q"].type == schema.Type("array", item=schema.Type("float"), max_length=64)
    assert sample["pose"].type == schema.Type("struct", name="Pose", optional=True)
    assert sample["twist"].type.length == 6
    assert (sample["seq"].required, sample["seq"].type.minimum) == (True, 0)
    assert (sample["tracked"].required, sample["tracked"].default, sample["device"].enum) == (False, True, "Device")
    assert by_name["ClientEnvelope"].fields[3].type == schema.Type("union", name="ClientMessage")
    assert by_name["Pose"].array_like
    assert by_name["Feedback"].fields[-1].default == {}
    visual = {field.name: field for field in by_name["Visual"].fields}
    assert visual["material"].type == schema.Type("int", minimum=-1, maximum=2**31 - 1)
    level = {field.name: field for field in by_name["MeshLevel"].fields}
    assert level["address"].type == schema.Type("str", pattern="^[0-9a-f]{64}$")
    change = {field.name: field for field in by_name["SetVisual"].fields}
    assert (by_name["SetVisual"].tag_field, change["group"].type.optional) == ("op", True)


def test_enumerations_of_fields_exist() -> None:
    known = schema.list_enums()
    used = {field.enum for struct in schema.list_all_structs() for field in struct.fields if field.enum}
    assert used <= set(known)
    assert known["Role"] == {
        role.upper(): role for role in sorted(names.Role.ALL, key=list(known["Role"].values()).index)
    }
    fields = {f"{struct.name}.{field.name}" for struct in schema.list_all_structs() for field in struct.fields}
    assert set(schema._ENUMS) <= fields


@pytest.mark.parametrize("kind", [list[int], set[str], int | str, tuple[int, str] | None])
def test_unsupported_types_are_rejected(kind: object) -> None:
    with pytest.raises(TypeError):
        schema._describe_type(msgspec.inspect.type_info(kind))


def test_every_struct_has_its_fields_in_typescript() -> None:
    text = typescript.render_typescript()
    for struct in schema.list_all_structs():
        form = rf"type {struct.name} = \[" if struct.array_like else rf"interface {struct.name} \{{"
        found = re.search(rf"export {form}\n(.*?)\n[\]}}]", text, re.DOTALL)
        assert found, struct.name
        for field in struct.fields:
            assert re.search(rf"^  {field.name}{'' if field.required else '[?]'}: ", found[1], re.MULTILINE), field.name


def test_csharp_has_what_headset_apps_use_and_nothing_else() -> None:
    """That classes have the fields and bounds of the schema is what their golden vectors show (tests/csharp)."""
    generated = {struct.name for struct in csharp.list_structs()}
    assert {struct.name for struct in schema.list_all_structs()} - generated >= csharp.LEFT_OUT
    assert {*csharp.ROOTS, "Sample", "AlignmentChanged", "SetVisual", "TextureLevel"} <= generated
    assert {*schema.list_enums()} >= csharp.LEFT_OUT_ENUMS
    assert len(csharp.render_csharp().splitlines()) <= 3_500


def test_links_of_the_document_resolve() -> None:
    text = (ROOT / "docs/protocol.md").read_text()
    headings = {
        re.sub(r"[^\w -]", "", line.lstrip("# ")).strip().lower().replace(" ", "-")
        for line in text.splitlines()
        if line.startswith("#")
    }
    for link in re.findall(r"\]\(#([^)]+)\)", text):
        assert link in headings, link
    for link in re.findall(r"\]\((protocol/[^)]+)\)", text):
        assert (ROOT / "docs" / link).exists(), link
