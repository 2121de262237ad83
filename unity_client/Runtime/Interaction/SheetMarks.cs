// The marks of a sheet: which one is touched next, where those that are touched were, and where the next one is expected.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;

namespace IrisSession.Interaction
{
    /// <summary>Marks of the first sheet of a session that has enough of them.</summary>
    public sealed class SheetMarks
    {
        /// <summary>So many marks make an alignment.</summary>
        public const int Least = 3;

        private readonly List<string> queue = new List<string>(); // still to be touched, the next one first
        private readonly Dictionary<string, Double3> touched = new Dictionary<string, Double3>(); // in the tracking frame
        private readonly HashSet<string> repeated = new HashSet<string>(); // the session asked for them once more
        private readonly List<PointPair> pairs = new List<PointPair>();
        private IReadOnlyDictionary<string, AnchorInfo> sheetOf;
        private RigidTransform T_world_sheet;

        /// <summary>Null: the session has none.</summary>
        public AnchorInfo Sheet { get; private set; }

        /// <summary>The mark to be touched next, empty for none.</summary>
        public string Next { get { return queue.Count > 0 ? queue[0] : ""; } }

        public int TouchedCount { get { return touched.Count; } }

        /// <summary>Take the sheets of the session. Returns whether the sheet is another one: nothing of it is touched.</summary>
        public bool TakeSheets(IReadOnlyDictionary<string, AnchorInfo> anchors)
        {
            if (ReferenceEquals(anchors, sheetOf)) return false;
            sheetOf = anchors;
            AnchorInfo found = null;
            foreach (AnchorInfo anchor in anchors.Values) if (found == null && anchor.Marks.Length >= Least) found = anchor;
            bool isOther = found?.Id != Sheet?.Id;
            Sheet = found;
            if (found != null) T_world_sheet = SceneDecoder.ToTransform(found.T_world_anchor);
            if (isOther) Reset();
            return isOther;
        }

        /// <summary>Nothing is touched.</summary>
        public void Reset()
        {
            touched.Clear();
            repeated.Clear();
            FillQueue();
        }

        /// <summary>The next mark was touched.</summary>
        public void TakeTouch(Double3 p_tracking_tip)
        {
            touched[queue[0]] = p_tracking_tip;
            queue.RemoveAt(0);
        }

        /// <summary>Marks that a refusal names are touched next. A mark that does not fit again comes last.</summary>
        public void TakeRefusal(string text)
        {
            int next = 0;
            foreach (AnchorMark mark in Sheet.Marks)
            {
                if (!text.Contains("'" + Sheet.Id + "/" + mark.Id + "'")) continue;
                touched.Remove(mark.Id);
                queue.Remove(mark.Id);
                if (repeated.Add(mark.Id)) queue.Insert(Math.Min(next++, queue.Count), mark.Id);
                else queue.Add(mark.Id);
            }
            if (queue.Count == 0) FillQueue();
        }

        /// <summary>Find where the next mark is expected, with the axes of its sheet: by the alignment, or by marks that are touched.</summary>
        public bool TryFindNext(ISessionPort session, out RigidTransform T_tracking_mark)
        {
            T_tracking_mark = RigidTransform.Identity;
            if (queue.Count == 0) return false;
            RigidTransform T_tracking_world;
            if (session.TryGetAlignment(out RigidTransform T_world_tracking)) T_tracking_world = T_world_tracking.Inverse;
            else
            {
                pairs.Clear();
                foreach (KeyValuePair<string, Double3> one in touched) pairs.Add(new PointPair(FindMark(one.Key), one.Value));
                if (!LevelFit.TryFit(pairs, out T_tracking_world)) return false;
            }
            T_tracking_mark = T_tracking_world * new RigidTransform(FindMark(queue[0]), T_world_sheet.Rotation);
            return true;
        }

        private void FillQueue()
        {
            queue.Clear();
            if (Sheet != null) foreach (AnchorMark mark in Sheet.Marks) queue.Add(mark.Id);
        }

        /// <summary>Return the position of a mark in the world.</summary>
        private Double3 FindMark(string id)
        {
            foreach (AnchorMark mark in Sheet.Marks)
                if (mark.Id == id) return T_world_sheet.TransformPoint(new Double3(mark.PAnchor[0], mark.PAnchor[1], mark.PAnchor[2]));
            return T_world_sheet.Position;
        }
    }
}
