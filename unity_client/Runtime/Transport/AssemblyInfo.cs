using System.Runtime.CompilerServices;

[assembly: InternalsVisibleTo("IrisSession.Transport.Tests")]
