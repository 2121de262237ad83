"""The Unity package: one assembly per layer, each with its tests; what Unity reads of it is consistent."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from tools.csharp.project import ROOT

PACKAGE = ROOT / "unity_client"
HOLOLENS = ROOT / "hololens_client"
ASSEMBLIES = {path: json.loads(path.read_text()) for path in sorted(PACKAGE.rglob("*.asmdef"))}
LAYERS = [path for path in ASSEMBLIES if path.relative_to(PACKAGE).parts[0] == "Runtime"]
#: Of both packages, for the editor alone.
COMMANDS = [path for folder in (PACKAGE, HOLOLENS) for path in sorted((folder / "Editor").rglob("*.asmdef"))]


def test_manifest_has_the_version_of_the_session() -> None:
    manifest = json.loads((PACKAGE / "package.json").read_text())
    assert manifest["version"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert re.fullmatch(r"com\.[a-z0-9._-]+", manifest["name"])


#: Assembly of a package of Unity -> the package.
PACKAGES_OF_UNITY = {
    "Microsoft.MixedReality.OpenXR": "com.microsoft.mixedreality.openxr",
    "Unity.InputSystem": "com.unity.inputsystem",
    "Unity.TextMeshPro": "com.unity.ugui",
    "Unity.XR.ARFoundation": "com.unity.xr.arfoundation",
    "Unity.XR.ARSubsystems": "com.unity.xr.arfoundation",
    "Unity.XR.CoreUtils": "com.unity.xr.core-utils",
    "Unity.XR.Hands": "com.unity.xr.hands",
    "Unity.XR.Management": "com.unity.xr.management",
    "Unity.XR.Management.Editor": "com.unity.xr.management",
    "Unity.XR.OpenXR": "com.unity.xr.openxr",
    "Unity.XR.OpenXR.Editor": "com.unity.xr.openxr",
    "Oculus.VR": "com.meta.xr.sdk.core",
    "meta.xr.mrutilitykit": "com.meta.xr.mrutilitykit",
}


def test_packages_that_layers_use_are_dependencies_of_one_version() -> None:
    """A package that is for several headsets asks for the oldest that will do; the list of one headset is exact."""
    dependencies = json.loads((PACKAGE / "Documentation~/quest-3.manifest.json").read_text())["dependencies"]
    least = json.loads((PACKAGE / "package.json").read_text())["dependencies"]
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", version) for version in (*dependencies.values(), *least.values()))
    numbers = {name: [int(part) for part in version.split(".")] for name, version in dependencies.items()}
    assert all([int(part) for part in version.split(".")] <= numbers[name] for name, version in least.items())
    for path in LAYERS:
        for name in (name for name in ASSEMBLIES[path]["references"] if name.startswith("Unity.")):
            assert PACKAGES_OF_UNITY[name] in dependencies, f"{path}: {name}"


def test_each_layer_is_an_assembly_with_tests() -> None:
    assert {"IrisSession.Protocol", "IrisSession.Core"} <= {ASSEMBLIES[path]["name"] for path in LAYERS}
    for path, content in ASSEMBLIES.items():
        assert path.stem == content["name"] == content["rootNamespace"]
    on_standins = json.loads(next((ROOT / "tests/csharp/unity").glob("*.asmdef")).read_text())
    for path in LAYERS:
        if not ASSEMBLIES[path]["noEngineReferences"]:
            assert path.stem in on_standins["references"]
            continue
        tests = PACKAGE / "Tests" / path.parent.name / f"{path.stem}.Tests.asmdef"
        assert path.stem in ASSEMBLIES[tests]["references"]
        assert "UNITY_INCLUDE_TESTS" in ASSEMBLIES[tests]["defineConstraints"]


def test_layers_with_an_engine_stay_thin() -> None:
    """A layer that runs on stand-ins only must be short enough to be read."""
    sources = {path: len(path.read_text().splitlines()) for path in (PACKAGE / "Runtime/Unity").rglob("*.cs")}
    hololens = {path: len(path.read_text().splitlines()) for path in HOLOLENS.rglob("*.cs")}
    assert hololens
    assert max({**sources, **hololens}.values()) < 400
    assert sum(hololens.values()) < 1000


def test_page_quotes_what_the_panels_say() -> None:
    page = (PACKAGE / "Documentation~/index.md").read_text()
    table = page.split("## What the panels say")[1].split("\n## ")[0]
    sources = "".join(path.read_text() for path in (PACKAGE / "Runtime").rglob("*.cs")).lower().replace('\\"', '"')
    cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| *")]
    quoted = [
        part.strip(" .'").lower()
        for cell in cells
        for one in re.findall(r"\*([^*]+)\*", cell)
        for part in one.split("...")
    ]
    assert len(quoted) > 20
    assert not [part for part in quoted if len(part) > 5 and part not in sources]


def test_hololens_needs_this_core() -> None:
    manifest = json.loads((HOLOLENS / "package.json").read_text())
    core = json.loads((PACKAGE / "package.json").read_text())
    assert manifest["dependencies"][core["name"]] == core["version"] == manifest["version"]


def test_assemblies_refer_to_those_that_exist() -> None:
    """Ours, and of packages that come with this one: what needs more waits for it by a constraint."""
    everything = {**ASSEMBLIES, **{path: json.loads(path.read_text()) for path in HOLOLENS.rglob("*.asmdef")}}
    names = {content["name"] for content in everything.values()} | {"UnityEngine.TestRunner", "UnityEditor.TestRunner"}
    come_with = {
        # The OpenXR plug-in brings the other two.
        PACKAGE: {"com.unity.inputsystem", "com.unity.xr.openxr", "com.unity.xr.management", "com.unity.xr.core-utils"},
        HOLOLENS: {*json.loads((HOLOLENS / "package.json").read_text())["dependencies"], "com.unity.xr.core-utils"},
    }
    for path, content in everything.items():
        needs = {PACKAGES_OF_UNITY[name] for name in content["references"] if name not in names}
        folder = PACKAGE if PACKAGE in path.parents else HOLOLENS
        missing = needs - come_with[folder]
        defined = {one["name"] for one in content.get("versionDefines", ())}
        assert not missing or defined & missing, f"{path}: {missing}"


def test_commands_are_for_the_editor_alone() -> None:
    assert len(COMMANDS) > 2
    for path in COMMANDS:
        assert json.loads(path.read_text())["includePlatforms"] == ["Editor"], path
    for path in [*LAYERS, *(HOLOLENS / "Runtime").rglob("*.asmdef")]:
        assert not re.search(r"\bUnityEditor\b", "".join(one.read_text() for one in path.parent.rglob("*.cs"))), path


def test_package_manager_shows_samples_and_pages() -> None:
    for folder in (PACKAGE, HOLOLENS):
        manifest = json.loads((folder / "package.json").read_text())
        for name in ("README.md", "LICENSE.md", "CHANGELOG.md", "Documentation~/index.md"):
            assert (folder / name).stat().st_size, name
        assert "[Unreleased] " + manifest["version"] in (folder / "CHANGELOG.md").read_text()
        listed = {sample["path"]: sample for sample in manifest.get("samples", ())}
        samples = {path.relative_to(folder).as_posix() for path in folder.glob("Samples~/*")}
        assert samples == {*listed}
        assert all(one["displayName"] and one["description"] for one in listed.values())


def test_page_has_the_versions_of_the_list() -> None:
    versions = json.loads((PACKAGE / "Documentation~/quest-3.manifest.json").read_text())["dependencies"]
    page = (PACKAGE / "Documentation~/index.md").read_text()
    shown = set(re.findall(r"\b\d+\.\d+\.\d+\b(?!f|\.\d)", page))
    assert shown <= {*versions.values()}, shown - {*versions.values()}
    holo = json.loads((HOLOLENS / "package.json").read_text())["dependencies"]
    page = (HOLOLENS / "Documentation~/index.md").read_text()
    assert all(version in page for name, version in holo.items() if not name.startswith("com.iris-session"))


def test_files_of_the_engine_can_be_read_at_once() -> None:
    for layer in [path for path in LAYERS if not ASSEMBLIES[path]["noEngineReferences"]] + COMMANDS:
        for source in layer.parent.rglob("*.cs"):
            assert len(source.read_text().splitlines()) < 400, source


def test_every_asset_has_an_id_of_its_own() -> None:
    """That each has one: tests/codegen."""
    ids = [re.search(r"^guid: ([0-9a-f]{32})$", path.read_text(), re.MULTILINE) for path in PACKAGE.rglob("*.meta")]
    assert all(ids)
    assert len({found[1] for found in ids if found}) == len(ids)


def test_sources_do_what_il2cpp_can_compile() -> None:
    """Neither reflection nor code that is made at run time, in what apps contain."""
    sources: list[Path] = [path for layer in LAYERS for path in layer.parent.rglob("*.cs")]
    assert len(sources) > 3
    for path in sources:
        found = re.search(r"System\.Reflection|Activator\.|\bdynamic\b|Linq\.Expressions|Emit\b", path.read_text())
        assert not found, f"{path}: {found}"


def test_shaders_and_materials_fit_the_code() -> None:
    """Shaders have the properties that the code sets and draw for both eyes; each material has its shader."""
    folder = PACKAGE / "Runtime/Unity"
    sources = {path: path.read_text() for path in (folder / "Shaders").iterdir() if path.suffix in (".shader", ".hlsl")}
    names = re.findall(r'PropertyToID\("(\w+)"\)', (folder / "IrisMaterials.cs").read_text())
    assert len(names) > 20
    assert not [name for name in names if not any(re.search(rf"\b{name}\b", text) for text in sources.values())]
    stereo = ("UNITY_VERTEX_INPUT_INSTANCE_ID", "UNITY_SETUP_INSTANCE_ID", "UNITY_INITIALIZE_VERTEX_OUTPUT_STEREO")
    for path, text in sources.items():
        if path.suffix == ".hlsl":
            continue
        assert all(macro in text for macro in stereo), path
        assert "UNITY_VERTEX_OUTPUT_STEREO" in text
        identity = re.search(r"^guid: (\w+)$", Path(f"{path}.meta").read_text(), re.MULTILINE)
        assert identity
        material = folder / "Materials" / f"{path.stem}.mat"
        assert f"guid: {identity[1]}," in material.read_text()
        assert "m_EnableInstancingVariants: 1" in material.read_text()
    limit = re.search(r"MaxLights = (\d+);", (PACKAGE / "Runtime/Core/SceneLighting.cs").read_text())
    assert limit
    assert f"#define IRIS_MAX_LIGHTS {limit[1]}" in sources[folder / "Shaders/IrisShared.hlsl"]
