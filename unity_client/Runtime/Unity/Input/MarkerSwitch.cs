// Switches a runtime's search for codes on and off, and notices where there is none.
using System;
using IrisSession.Interaction;
using UnityEngine;

namespace IrisSession.Unity.Input
{
    /// <summary>Sets the `enabled` of a manager of codes, whose subsystem is there once it is on. One that cannot start switches itself off.</summary>
    public sealed class MarkerSwitch
    {
        /// <summary>A search that cannot start is tried again after this time [s]: each try writes an error to the log.</summary>
        private const double RetryS = 30.0;

        private readonly Behaviour manager;
        private readonly Func<MarkerSupport> judge;
        private bool isOn;
        private bool isReady;
        private bool hasFailed;
        private double retryAt;

        /// <param name="manager">Null: this device has none.</param>
        /// <param name="judge">Says whether a manager that is on can read codes; asked until it is `Ready`.</param>
        public MarkerSwitch(Behaviour manager, Func<MarkerSupport> judge)
        {
            this.manager = manager;
            this.judge = judge;
        }

        /// <summary>`Missing` from a start that failed to the next one that does not.</summary>
        public MarkerSupport Support
        {
            get { return manager == null || hasFailed ? MarkerSupport.Missing : isOn && !isReady ? MarkerSupport.Starting : MarkerSupport.Ready; }
        }

        /// <summary>Call it at every frame.</summary>
        public void Set(bool isWanted)
        {
            if (manager == null) return;
            double now = Time.realtimeSinceStartupAsDouble;
            if (isOn) Check(now);
            isOn = isWanted && now >= retryAt;
            isReady &= isOn;
            if (manager.enabled != isOn) manager.enabled = isOn;
        }

        private void Check(double now)
        {
            MarkerSupport found = !manager.enabled ? MarkerSupport.Missing : isReady ? MarkerSupport.Ready : judge();
            isReady = found == MarkerSupport.Ready;
            if (isReady) hasFailed = false;
            if (found != MarkerSupport.Missing) return;
            hasFailed = true;
            retryAt = now + RetryS;
        }
    }
}
