from starcat.artifact.diff import Difference as Difference
from starcat.artifact.diff import diff_artifacts as diff_artifacts
from starcat.artifact.manifest import MANIFEST_NAME as MANIFEST_NAME
from starcat.artifact.manifest import read_manifest as read_manifest
from starcat.artifact.reader import DatabaseFolder as DatabaseFolder
from starcat.artifact.reader import open_artifact as open_artifact
from starcat.artifact.verify import check_artifact as check_artifact
