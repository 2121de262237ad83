// The menu command that makes the scene of Quest 3: the rig of all headsets, passthrough, QR codes.
using IrisSession.Unity.ArFoundation;
using UnityEditor;
using UnityEngine.SceneManagement;
using UnityEngine.XR.ARFoundation;

namespace IrisSession.Editor.QuestScene
{
    public static class QuestSceneCommand
    {
        private const string Title = "Create Scene";

        [MenuItem("Iris Session/" + Title, false, 20)]
        public static void Create() { SetupReport.Run(Title, Apply); }

        private static void Apply(SetupReport report)
        {
            if (!SceneAssets.TryOpen(out Scene scene)) return; // cancelled
            SceneRig rig = new SceneRig(scene, report);
            rig.Need<ARSession>(rig.FindRoot("AR Session"));
            ARCameraManager room = rig.Need<ARCameraManager>(rig.Camera.gameObject);
            ARMarkerManager codes = rig.Need<ARMarkerManager>(rig.Origin.gameObject);
            IrisQuest quest = rig.Need<IrisQuest>(rig.Offset);
            if (report.Changes.Count > 0)
            {
                codes.enabled = false; // until the wearer has allowed it
                quest.SetUp(rig.Origin, codes, room);
                EditorUtility.SetDirty(quest);
            }
            SceneAssets.Save(scene, report);
        }
    }
}
