// The menu command that makes the scene of HoloLens 2: the rig of all headsets, and QR codes.
using IrisSession.Editor;
using Microsoft.MixedReality.OpenXR;
using UnityEditor;
using UnityEngine.SceneManagement;
using UnityEngine.XR.ARFoundation;

namespace IrisSession.HoloLens.Editor
{
    public static class HoloLensScene
    {
        private const string Title = "Create Scene";

        [MenuItem("Iris Session/" + Title, false, 20)]
        public static void Create() { SetupReport.Run(Title, Apply); }

        private static void Apply(SetupReport report)
        {
            if (!SceneAssets.TryOpen(out Scene scene)) return; // cancelled
            SceneRig rig = new SceneRig(scene, report);
            rig.Need<ARSession>(rig.FindRoot("AR Session"));
            Microsoft.MixedReality.OpenXR.ARMarkerManager codes = rig.Need<Microsoft.MixedReality.OpenXR.ARMarkerManager>(rig.Origin.gameObject);
            IrisHoloLens hololens = rig.Need<IrisHoloLens>(rig.Offset);
            if (report.Changes.Count > 0)
            {
                codes.enabledMarkerTypes = new[] { ARMarkerType.QRCode };
                codes.defaultTransformMode = TransformMode.Center;
                codes.enabled = false; // until a session has sheets
                hololens.SetUp(rig.Origin, codes);
                EditorUtility.SetDirty(codes);
                EditorUtility.SetDirty(hololens);
            }
            SceneAssets.Save(scene, report);
        }
    }
}
