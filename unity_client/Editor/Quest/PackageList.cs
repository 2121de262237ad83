// The packages of a headset, with exact versions: those that a project lacks are added.
using System.Collections.Generic;
using System.IO;
using System.Text.RegularExpressions;
using UnityEditor;
using UnityEditor.PackageManager;
using UnityEditor.PackageManager.Requests;
using UnityEngine;
using PackageInfo = UnityEditor.PackageManager.PackageInfo;

namespace IrisSession.Editor.Quest
{
    /// <summary>Reads a list of the package's documentation, which is what the page for people shows, too.</summary>
    public static class PackageList
    {
        private const string Home = "Packages/com.iris-session.unity/package.json";
        private const string Module = "com.unity.modules.";
        private static AddAndRemoveRequest request;

        /// <summary>Ask Unity for packages of the list that are missing or older. False: it has to install first.</summary>
        public static bool Install(string list, SetupReport report)
        {
            string text = File.ReadAllText(Path.Combine(PackageInfo.FindForAssetPath(Home).resolvedPath, "Documentation~", list));
            List<string> missing = new List<string>();
            foreach (Match one in Regex.Matches(text, "\"(com\\.[a-z0-9.-]+)\": \"([0-9.]+)\""))
            {
                if (one.Groups[1].Value.StartsWith(Module)) continue; // part of the editor, without files of its own
                PackageInfo there = PackageInfo.FindForAssetPath("Packages/" + one.Groups[1].Value + "/package.json");
                if (there == null || IsOlder(there.version, one.Groups[2].Value)) missing.Add(one.Groups[1].Value + "@" + one.Groups[2].Value);
            }
            if (missing.Count == 0) return true;
            request = Client.AddAndRemove(missing.ToArray());
            EditorApplication.update -= Watch;
            EditorApplication.update += Watch;
            report.Change("packages are being added: " + string.Join(", ", missing));
            report.Leave("wait until Unity has installed them (answer Yes where it asks about the Input System), then choose the command again");
            return false;
        }

        /// <summary>Say why the packages were not installed. Once they are, Unity loads all code anew, and this ends.</summary>
        private static void Watch()
        {
            if (!request.IsCompleted) return;
            EditorApplication.update -= Watch;
            if (request.Error != null) Debug.LogError("Iris Session: no package was installed: " + request.Error.message);
        }

        /// <summary>Compare versions like 1.17.1 or 2.5.0-pre.1, which counts as 2.5.0.</summary>
        public static bool IsOlder(string version, string wanted)
        {
            string[] ours = version.Split('-')[0].Split('.');
            string[] theirs = wanted.Split('.');
            for (int i = 0; i < ours.Length && i < theirs.Length; i++)
            {
                int difference = int.Parse(ours[i]) - int.Parse(theirs[i]);
                if (difference != 0) return difference < 0;
            }
            return false;
        }
    }
}
