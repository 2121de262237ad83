using System.Runtime.CompilerServices;

[assembly: InternalsVisibleTo("IrisSession.Transport.Tests")]
[assembly: InternalsVisibleTo("IrisSession.Unity.StandinTests")]
