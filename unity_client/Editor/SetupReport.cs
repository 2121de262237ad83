// What a menu command has changed and what is left for a person, as lines of the console.
using System;
using System.Collections.Generic;
using UnityEngine;

namespace IrisSession.Editor
{
    /// <summary>Sets what differs and says so. A second run of a command changes nothing.</summary>
    public sealed class SetupReport
    {
        private const string Sign = "Iris Session: ";

        private readonly List<string> changes = new List<string>();
        private readonly List<string> left = new List<string>();

        public IReadOnlyList<string> Changes { get { return changes; } }

        /// <summary>Steps that a person has to do.</summary>
        public IReadOnlyList<string> Left { get { return left; } }

        /// <summary>Run a command, and say at its end what it did. What it throws is said and goes no further.</summary>
        public static SetupReport Run(string title, Action<SetupReport> command)
        {
            SetupReport report = new SetupReport();
            try
            {
                command(report);
            }
            catch (Exception error)
            {
                Debug.LogException(error);
                report.Leave("'" + title + "' stopped halfway: the line above says why; choose it again after that is mended");
            }
            string end = report.changes.Count == 0 ? "nothing to change" : report.changes.Count + " changes";
            Debug.Log(Sign + title + ": " + end + (report.left.Count == 0 ? "" : ", " + report.left.Count + " steps by hand (the warnings above)"));
            return report;
        }

        public void Change(string what)
        {
            changes.Add(what);
            Debug.Log(Sign + what);
        }

        public void Leave(string what)
        {
            left.Add(what);
            Debug.LogWarning(Sign + "by hand: " + what);
        }

        public void Set<T>(string what, T now, T wanted, Action<T> set)
        {
            if (EqualityComparer<T>.Default.Equals(now, wanted)) return;
            set(wanted);
            Change(what + ": " + now + " -> " + wanted);
        }
    }
}
