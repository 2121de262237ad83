// The component that draws a session: put it on the object in whose frame the headset tracks.
using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using UnityEngine;

namespace IrisSession.Unity
{
    /// <summary>What is drawn. Members are called on the engine's thread, but for `Find`.</summary>
    public interface IWorldSource : ISceneAssets
    {
        /// <summary>Session time now [ns].</summary>
        long SessionNowNs { get; }

        /// <summary>Who is in the session, by id.</summary>
        IReadOnlyDictionary<string, ParticipantInfo> Participants { get; }

        /// <summary>Bring what has come since the last frame: scene, states, presence, media, alignment. Must not wait.</summary>
        void Update(WorldView world);
    }

    /// <summary>Draws what a source brings. After the components that read devices, so that nothing is drawn a frame late.</summary>
    [DefaultExecutionOrder(100)]
    public sealed class IrisWorld : MonoBehaviour
    {
        [SerializeField] private IrisMaterials materials = new IrisMaterials();
        private IWorldSource source;
        private int cloudsLeftOut;

        /// <summary>What is drawn, null without a session.</summary>
        public WorldView World { get; private set; }

        /// <summary>What is not drawn, and why, for people; empty while all is well.</summary>
        public string Problem { get; private set; } = "";

        /// <summary>Ghosts of the robots' hands that the wearer drives; null: none.</summary>
        public HandGhosts Ghosts { get; set; }

        /// <summary>What is drawn at most; set before <see cref="Show"/>.</summary>
        public DrawBudget Draws { get; set; } = DrawBudget.Quest3;

        /// <summary>Materials of the package, for those who make this component in code.</summary>
        public IrisMaterials Materials { get { return materials; } }

        /// <summary>Draw a session; null: none any more.</summary>
        public void Show(IWorldSource source)
        {
            World?.Dispose();
            World = null;
            cloudsLeftOut = 0;
            this.source = source;
            Problem = source != null && !materials.AreSet ? "IrisWorld has no materials: set IrisSurface and IrisPoints of the package" : "";
            if (source != null && Problem.Length == 0) World = new WorldView(transform, materials, source, Draws);
        }

        private void LateUpdate()
        {
            if (World == null) return;
            try
            {
                source.Update(World);
                Ghosts?.Show(World);
                World.Draw(source.SessionNowNs, Time.realtimeSinceStartupAsDouble, source.Participants);
                if (World.CloudsLeftOut == cloudsLeftOut) return;
                cloudsLeftOut = World.CloudsLeftOut;
                Problem = cloudsLeftOut == 0 ? "" : cloudsLeftOut + " clouds of points are not shown: this headset draws " + Draws.Clouds;
            }
            catch (Exception error)
            {
                // A defect: it is said once, and the application goes on without a world.
                Debug.LogException(error);
                Show(null);
                Problem = "the world cannot be drawn: " + error.Message;
            }
        }

        private void OnDestroy() { Show(null); }
    }
}
