"""Compile every .proto file of this folder into the checked-in descriptor set: `python -m schemas.build`.

Needs grpcio-tools (extra `dev`). Nothing else does: message classes are built from the set at run time.
"""

import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).parent
DESCRIPTORS = FOLDER / "descriptors.binpb"
PACKAGE_FOLDER = "duagc/v1"


def compile_descriptors() -> bytes:
    """Serialized FileDescriptorSet of all .proto files in this folder and what they import, without comments."""
    import grpc_tools
    from grpc_tools import protoc

    files = [f"{PACKAGE_FOLDER}/{path.name}" for path in sorted(FOLDER.glob("*.proto"))]
    well_known = Path(grpc_tools.__file__).parent / "_proto"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "set.binpb"
        arguments = [f"-I{PACKAGE_FOLDER}={FOLDER}", f"-I{well_known}", "--include_imports"]
        if protoc.main(["protoc", *arguments, f"--descriptor_set_out={out}", *files]) != 0:
            raise SystemExit("protoc failed; its message is above")
        return out.read_bytes()


if __name__ == "__main__":
    DESCRIPTORS.write_bytes(compile_descriptors())
    print(f"{DESCRIPTORS.name}: {DESCRIPTORS.stat().st_size} bytes", file=sys.stderr)
