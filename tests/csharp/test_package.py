"""The Unity package: one assembly per layer, each with its tests; what Unity reads of it is consistent."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from tools.csharp.project import ROOT

PACKAGE = ROOT / "unity_client"
ASSEMBLIES = {path: json.loads(path.read_text()) for path in sorted(PACKAGE.rglob("*.asmdef"))}
LAYERS = [path for path in ASSEMBLIES if path.relative_to(PACKAGE).parts[0] == "Runtime"]


def test_manifest_has_the_version_of_the_session() -> None:
    manifest = json.loads((PACKAGE / "package.json").read_text())
    assert manifest["version"] == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert re.fullmatch(r"com\.[a-z0-9._-]+", manifest["name"])


#: Assembly of a package of Unity -> the package.
PACKAGES_OF_UNITY = {
    "Unity.InputSystem": "com.unity.inputsystem",
    "Unity.TextMeshPro": "com.unity.ugui",
    "Unity.XR.ARFoundation": "com.unity.xr.arfoundation",
    "Unity.XR.ARSubsystems": "com.unity.xr.arfoundation",
    "Unity.XR.CoreUtils": "com.unity.xr.core-utils",
    "Unity.XR.Hands": "com.unity.xr.hands",
    "Unity.XR.Management": "com.unity.xr.management",
    "Unity.XR.OpenXR": "com.unity.xr.openxr",
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
    hololens = {path: len(path.read_text().splitlines()) for path in (ROOT / "hololens_client").rglob("*.cs")}
    assert hololens
    assert max({**sources, **hololens}.values()) < 400
    assert sum(hololens.values()) < 1000


def test_hololens_needs_this_core() -> None:
    manifest = json.loads((ROOT / "hololens_client/package.json").read_text())
    core = json.loads((PACKAGE / "package.json").read_text())
    assert manifest["dependencies"][core["name"]] == core["version"] == manifest["version"]


def test_layers_refer_to_assemblies_that_exist() -> None:
    names = {content["name"] for content in ASSEMBLIES.values()}
    for content in ASSEMBLIES.values():
        own = {name for name in content["references"] if name.startswith("IrisSession.")}
        assert own <= names


def test_files_of_the_engine_can_be_read_at_once() -> None:
    for layer in (path for path in LAYERS if not ASSEMBLIES[path]["noEngineReferences"]):
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
