using System.Runtime.CompilerServices;

[assembly: InternalsVisibleTo("IrisSession.Unity.StandinTests")]
[assembly: InternalsVisibleTo("headless")]
[assembly: InternalsVisibleTo("app")]
